"""Start a node, spin it, and leave with the right exit code whatever ends it."""

from __future__ import annotations

import contextlib
import gc
import sys
from collections.abc import Callable, Sequence

import rclpy
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from limb_interfaces import transport
from limb_interfaces.entry import on_end_signals


def run_node(
    create: Callable[[], Node],
    arguments: Sequence[str] | None = None,
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
        arguments: command line, `sys.argv` if None.
        create_executor: makes what spins the node.

    Returns:
        0 after one of these signals, 1 after an error.
    """
    # A handler may interrupt itself: appending takes no lock, as an Event would.
    signals: list[int] = []
    transport.use_large_messages()
    transport.keep_buffers()
    on_end_signals(lambda number, _: signals.append(number))
    try:
        rclpy.init(
            args=list(arguments) if arguments is not None else None,
            signal_handler_options=SignalHandlerOptions.NO,
        )
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
        exit_code = max(exit_code, _close(node))
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


def _close(node: Node | None) -> int:
    """Close and destroy a node; return 1 if it could not leave all in order."""
    if node is None:
        return 0
    exit_code = 0
    try:
        if hasattr(node, "close"):
            node.close()
    except Exception as error:
        exit_code = 1
        _complain(node, error)
    with contextlib.suppress(Exception):
        node.destroy_node()
    return exit_code
