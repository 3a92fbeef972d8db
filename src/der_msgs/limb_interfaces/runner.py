"""Start a node, spin it, and leave with the right exit code whatever ends it."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
from collections.abc import Callable
from pathlib import Path

import rclpy
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from limb_interfaces.entry import on_end_signals

PROFILE = Path("share/apriltag_tracker/config/fastdds_large_images.xml")
"""Below the prefix into which `apriltag_tracker` is installed."""
_SETTINGS = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""Environment variables that name a profile of Fast DDS."""
_LOCAL = "DEFAULT_FASTRTPS_PROFILES.xml"
"""File in the working folder that Fast DDS reads where no variable names another."""

_THRESHOLDS = (-1, -3)
"""Settings M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of `malloc.h` of the GNU C library."""
_KEPT = 64 << 20
"""Memory that a process keeps for its next messages [bytes]."""


def run_node(
    create: Callable[[], Node],
    create_executor: Callable[[], Executor] = SingleThreadedExecutor,
) -> int:
    r"""Create a node, spin it until a signal ends it, close it, and return the exit code.

    The signals are those of `limb_interfaces.entry.END_SIGNALS`: Ctrl-C, SIGTERM, a terminal that
    was closed (a dropped ssh, too) and Ctrl-\ end a node in the same order.

    A node with a ``close`` method, which vents, flushes or releases, has it called once while its
    publishers still work, whatever ended the spinning: a signal, an exception in a callback, or the
    end of the context. A node that cannot go on sets its attribute ``fatal_error`` to a sentence,
    and the process ends with it.

    Args:
        create: makes the node; an exception ends the process with exit code 1 and its message.
        create_executor: makes what spins the node.

    Returns:
        0 after one of these signals, 1 after an error.
    """
    # A handler may interrupt itself: appending takes no lock, as an Event would.
    signals: list[int] = []
    use_large_messages()
    keep_buffers()
    on_end_signals(lambda number, _: signals.append(number))
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # e.g. a parameter file that is not there
        _complain(None, error)
        return 1
    node: Node | None = None
    exit_code = 0
    try:
        node = create()
        _keep_for_good()
        executor = create_executor()
        executor.add_node(node)
        while rclpy.ok() and not signals:
            executor.spin_once(timeout_sec=0.1)
            if fatal := getattr(node, "fatal_error", None):
                raise RuntimeError(fatal)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception as error:
        exit_code = 1
        _complain(node, error)
    finally:
        exit_code = _close(node, exit_code)
        with contextlib.suppress(Exception):
            rclpy.try_shutdown()
    return exit_code


def _keep_for_good() -> None:
    """Have Python's collector leave alone what there is when a node begins to work.

    It lives as long as the process: hundreds of thousands of objects of libraries, which every full
    collection would look through for tens of milliseconds in the midst of some callback.
    """
    gc.collect()
    gc.freeze()


def _complain(node: Node | None, error: Exception) -> None:
    text = str(error) or type(error).__name__
    if node is not None:
        node.get_logger().fatal(text)
    with contextlib.suppress(OSError):  # the terminal may have been closed
        print(f"error: {text}", file=sys.stderr, flush=True)


def _close(node: Node | None, exit_code: int) -> int:
    """Close and destroy a node; return the exit code, 1 if it could not leave all in order."""
    if node is None:
        return exit_code
    try:
        if hasattr(node, "close"):
            node.close()
    except Exception as error:
        exit_code = 1
        _complain(node, error)
    with contextlib.suppress(Exception):
        if exit_code == 0 and hasattr(node, "conclude"):
            node.conclude()
        node.destroy_node()
    return exit_code


def keep_buffers() -> None:
    """Have the memory of a message kept for the next one, instead of given back and asked for anew.

    The C library gives an image's memory back to the kernel with every message, and the next one
    then faults once a page: 1.4 of the 2.6 ms of CPU of receiving an image of 1280 x 720.
    """
    with contextlib.suppress(OSError, AttributeError):  # another C library has no such setting
        library = ctypes.CDLL(None)
        for key in _THRESHOLDS:
            library.mallopt(key, _KEPT)


def use_large_messages() -> Path | None:
    """Make Fast DDS carry camera images within the machine, unless somebody has set it up already.

    With its own defaults more than half of all 720p images are lost without a word. It must be
    called before rclpy is initialised.

    Returns:
        The profile that was set; None if another is set already, or none is installed.
    """
    if any(os.environ.get(name) for name in _SETTINGS) or Path(_LOCAL).exists():
        return None
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        profile = Path(prefix) / PROFILE
        if prefix and profile.is_file():
            os.environ[_SETTINGS[0]] = str(profile)
            return profile
    return None
