"""Keeping time in a Python process: priority, and short waits for the interpreter lock."""

from __future__ import annotations

import contextlib
import os
import sys

SWITCH_INTERVAL = 0.0005
"""[s] after which a thread that computes hands the interpreter lock to one that waits for it."""


def prefer_thread(priority: int) -> bool:
    """Give the calling thread real-time priority (SCHED_FIFO).

    Args:
        priority: 1 … 99, 0 to leave the thread as it is.

    Returns:
        Whether it was granted; it needs root, CAP_SYS_NICE or an rtprio limit.
    """
    if priority <= 0:
        return False
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        return True
    return False


def prepare_process(priority: int) -> None:
    """Make this process's other threads stand in the way of a punctual one as little as they can.

    The main thread gets a lower real-time priority than the punctual thread: a thread that is
    displaced by other processes while it holds the interpreter lock keeps it from everybody.
    Threads of ROS keep ordinary priority: with a real-time one, they could keep a core from the
    program that holds a lock of the shared memory which they wait for.

    Args:
        priority: that the punctual thread will have, 0 for none.
    """
    sys.setswitchinterval(SWITCH_INTERVAL)
    prefer_thread(max(priority - 1, 0))
