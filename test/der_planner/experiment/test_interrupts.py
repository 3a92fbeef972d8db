"""What ends a run ends it once, with its name: also what a closed terminal or a quit key sends."""

import signal
import subprocess
import sys

import pytest

from der_planner.experiment.console import interrupt_once
from der_planner.experiment.graph_trials import warning_of
from der_planner.experiment.processes import GraphError
from limb_interfaces.entry import END_SIGNALS


@pytest.mark.parametrize("number", END_SIGNALS, ids=lambda number: number.name)
def test_a_second_signal_does_not_cut_the_end_short(number: signal.Signals):
    before = {each: signal.getsignal(each) for each in END_SIGNALS}
    try:
        interrupt_once()
        with pytest.raises(KeyboardInterrupt, match=number.name):
            signal.raise_signal(number)
        signal.raise_signal(number)
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


def test_a_signal_that_comes_while_an_object_is_deleted_still_ends_the_run():
    code = """
import signal, time
from der_planner.experiment.console import interrupt_once

class Item:
    def __del__(self):
        signal.raise_signal(signal.SIGTERM)

interrupt_once()
Item()
try:
    time.sleep(60.0)
except KeyboardInterrupt as error:
    print(error)
"""
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=30.0, check=True
    )
    assert found.stdout == "SIGTERM\n"
    assert not found.stderr


@pytest.mark.parametrize("state", ["vented", "idle"])
def test_a_plan_that_was_ended_is_no_trial(state: str):
    told = {"plan_id": "mine", "state": "streaming", "reason": "a slow limb"}
    assert warning_of(told, "mine") == "a slow limb"
    told |= {"state": state, "reason": "something touched the limb"}
    assert warning_of(told, "another") == ""
    with pytest.raises(GraphError, match="not played to its end: something touched the limb"):
        warning_of(told, "mine")
