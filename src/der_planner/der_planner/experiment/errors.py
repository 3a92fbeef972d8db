"""What can go wrong in a run, said so that the reader knows what to do."""


class NodeError(RuntimeError):
    """A node did not start or died; the message names it and shows its last words."""


class GraphError(RuntimeError):
    """The graph did not do what was asked; the message says what and why."""
