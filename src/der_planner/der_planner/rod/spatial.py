class SpatialBackend:
    def __init__(self, mesh):
        raise NotImplementedError
