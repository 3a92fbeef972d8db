"""Where a node's process begins: signals end it quietly before the node's code is even loaded."""

from __future__ import annotations

import importlib
import os
import signal
import sys
from collections.abc import Callable
from types import FrameType

END_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
"""What ends a node in order: Ctrl-C, a request, a terminal that was closed, and Ctrl-\\."""
EXTRAS = {
    name: name
    for name in ("cobs", "distributed", "mcap", "nicegui", "piqp", "rosbags", "threadpoolctl")
} | {"elastica": "pyelastica"}
"""Modules that no rosdep key brings, and the packages of pip that do."""


def on_end_signals(handler: Callable[[int, FrameType | None], None] | signal.Handlers) -> None:
    """Have `END_SIGNALS` handled; a SIGHUP that `nohup` has switched off stays so."""
    for number in END_SIGNALS:
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def run_module(name: str) -> int:
    """Load a node's module, which takes a second, and run its ``main``.

    Until `limb_interfaces.runner.run_node` takes over, there is nothing to bring in order: a
    signal ends the process with exit code 0 and without a word.

    Args:
        name: of the module.

    Returns:
        What ``main`` returns, or 0; 1 where one of `EXTRAS` is missing, 2 for arguments that no
        node takes; both are told.
    """
    on_end_signals(lambda *_: os._exit(0))
    if left := _outside_of_ros_args(sys.argv[1:]):
        print(
            f"'{' '.join(left)}' stands outside of --ros-args. Parameters are given as "
            "--ros-args -p NAME:=VALUE; while it runs, `ros2 param list` names them",
            file=sys.stderr,
        )
        return 0 if left in (["-h"], ["--help"]) else 2
    try:
        exit_code = int(importlib.import_module(name).main() or 0)
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in EXTRAS:
            raise
        print(f"error: this node needs '{missing}': pip install {EXTRAS[missing]}", file=sys.stderr)
        return 1
    # A second signal must not change the exit code while Python takes itself down.
    on_end_signals(signal.SIG_IGN)
    return exit_code


def _outside_of_ros_args(words: list[str]) -> list[str]:
    """Return the words of a command line that ROS takes no notice of.

    `rclpy.utilities.remove_ros_args` takes a second to load, and raises where a file is missing.
    """
    left, is_of_ros = [], False
    for word in words:
        if word in ("--ros-args", "--"):
            is_of_ros = word == "--ros-args"
        elif not is_of_ros:
            left.append(word)
    return left
