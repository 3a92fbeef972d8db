"""What ends a run ends it once, with its name: also what a closed terminal or a quit key sends."""

import signal
import subprocess
import sys

import pytest

from limb_interfaces.entry import END_SIGNALS

PROGRAM = """
import signal
from der_planner.experiment.console import interrupt_once
interrupt_once()
try:
    print("ready", flush=True)
    signal.pause()
except KeyboardInterrupt as error:
    print(error, flush=True)
    input()  # a second signal in this time must not cut the end short
    print("ended in order")
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", END_SIGNALS, ids=lambda number: number.name)
def test_a_second_signal_does_not_cut_the_end_short(number: signal.Signals):
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    process.send_signal(number)
    assert process.stdout.readline() == f"{number.name}\n"
    process.send_signal(number)
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()
    assert process.stdout.readline() == "ended in order\n"
    assert process.wait(10) == 0
