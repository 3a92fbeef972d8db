"""Who goes before whom in the driver's process."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from pressure_driver.realtime import prefer_thread

_PREPARE = """
import os, threading
from pressure_driver.realtime import prefer_thread, prepare_process
end, ready = threading.Event(), threading.Event()
threading.Thread(target=end.wait).start()  # as those of ROS, which are there before
prepare_process(10)
def punctual():
    prefer_thread(10)
    ready.set()
    end.wait()
threading.Thread(target=punctual).start()
threading.Thread(target=end.wait).start()
ready.wait()
threads = list(map(int, os.listdir("/proc/self/task")))
priorities = [os.sched_getparam(thread).sched_priority for thread in threads]
print(sorted(zip(map(os.sched_getscheduler, threads), priorities)))
end.set()
"""


def _permitted() -> bool:
    code = (
        "import sys; from pressure_driver.realtime import prefer_thread as p; sys.exit(not p(10))"
    )
    return subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_punctual_thread_goes_first_then_what_the_main_thread_starts() -> None:
    if not _permitted():
        pytest.skip("no right to real-time priority")
    found = subprocess.check_output([sys.executable, "-c", _PREPARE], text=True)
    before, below, punctual = (os.SCHED_OTHER, 0), (os.SCHED_FIFO, 9), (os.SCHED_FIFO, 10)
    assert found.strip() == str([before, below, below, punctual])


def test_without_a_priority_everything_stays_as_it_is() -> None:
    assert not prefer_thread(0)
