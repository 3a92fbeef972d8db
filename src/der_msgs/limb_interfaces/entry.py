"""Where a node's process begins: signals end it quietly before the node's code is even loaded."""

from __future__ import annotations

import importlib
import os
import signal

END_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
"""What ends a node in order: Ctrl-C, a request, a terminal that was closed, and Ctrl-\\."""


def run_module(name: str) -> int:
    """Load a node's module, which takes a second, and run its ``main``.

    Until `limb_interfaces.runner.run_node` takes over, there is nothing to bring in order: a
    signal ends the process with exit code 0 and without a word.

    Args:
        name: of the module.

    Returns:
        What ``main`` returns, or 0.
    """
    for number in END_SIGNALS:
        signal.signal(number, lambda *_: os._exit(0))
    return int(importlib.import_module(name).main() or 0)
