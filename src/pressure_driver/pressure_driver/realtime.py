"""Keeping time in a Python process: priority, and short waits for the interpreter lock."""

from __future__ import annotations

import contextlib
import gc
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

    All threads that there are get a lower real-time priority than the punctual one, those of ROS,
    too: a thread that is displaced by other processes while it holds the interpreter lock keeps it
    from everybody, and so does one that publishes, with this lock, while a displaced thread of ROS
    holds what it waits for. Threads that it starts later have its priority from it.

    Args:
        priority: that the punctual thread will have, 0 for none.
    """
    sys.setswitchinterval(SWITCH_INTERVAL)
    gc.collect()
    gc.freeze()  # what is there at the start stays: collections are fewer and shorter
    for thread in os.listdir("/proc/self/task") if priority > 1 else ():
        with contextlib.suppress(OSError):  # no right to it, or the thread has ended
            os.sched_setscheduler(int(thread), os.SCHED_FIFO, os.sched_param(priority - 1))
