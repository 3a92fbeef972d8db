"""What can go wrong before and in a run, said so that the reader knows what to do."""


class NodeError(RuntimeError):
    """A node did not start or died; the message names it and shows its last words."""


class GraphError(RuntimeError):
    """The graph did not do what was asked; the message says what and why."""


class OptionError(ValueError):
    """The command line or the hardware file asks for something impossible; says what and why."""
