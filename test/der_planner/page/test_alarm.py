"""The alarm: worst first, plain words, never live on old data, and what to do."""

from __future__ import annotations

import math
import socket
import subprocess
import sys
from typing import Any

import pytest
from rcl_interfaces.msg import Log
from statuses import status
from waiting import Clock, wait_for

from der_msgs.msg import LimbContact, PressureState
from der_planner.page.situation import DEAD, FRESH, Situation, as_typed
from limb_interfaces.diagnostics import ENDED_IN_ORDER, TOUCHED


def state(mode: int, measured: float = 0.0, **fields: Any) -> PressureState:
    return PressureState(
        mode=mode, measured_differential=[measured, 0.0], commanded_differential=[0.0, 0.0],
        **fields,
    )  # fmt: skip


def alarms(situation: Situation) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = situation.snapshot()["alarms"]
    return found


def test_a_limb_that_is_well_alarms_nobody(situation: Situation) -> None:
    for name in ("pressure_driver", "planner", "recorder"):
        situation.put_status(status(f"/limb/{name}"))
    situation.put_driver(state(PressureState.TRACKING, 9_000.0))
    assert alarms(situation) == []


def test_a_page_without_a_driver_says_how_to_start_one(situation: Situation) -> None:
    (alarm,) = alarms(situation)
    assert (alarm["level"], alarm["text"]) == ("notice", "No driver is heard")
    assert "ros2 run pressure_driver pressure_driver" in alarm["advice"]


@pytest.mark.parametrize(
    ("limit", "measured", "limb"),
    [
        ("4000", 900.0, "under pressure (0.9 kPa)"),
        ("24000", 900.0, "without pressure"),
        ("250000", 9_000.0, "without pressure"),
        ("250000", 11_000.0, "under pressure (11.0 kPa)"),
    ],
)
def test_a_limb_is_under_pressure_from_a_share_of_the_drivers_limit_on(
    situation: Situation, limit: str, measured: float, limb: str
) -> None:
    situation.put_status(status("/limb/pressure_driver", pressure_limit_pa=limit))
    situation.put_driver(state(PressureState.DISARMED, measured))
    assert situation.snapshot()["limb_is"] == limb


@pytest.mark.parametrize(
    ("measured", "limb"),
    [(13_400.0, "under pressure (13.4 kPa)"), (40.0, "without pressure"), (math.nan, "unknown")],
)
def test_a_silent_driver_is_said_first_with_what_the_limb_did(
    situation: Situation, clock: Clock, measured: float, limb: str
) -> None:
    situation.put_status(status("/limb/planner"))
    situation.put_driver(state(PressureState.TRACKING, measured))
    clock.now += max(FRESH["driver"], DEAD) + 0.1
    first, second = alarms(situation)
    assert first["level"] == "danger"
    assert first["text"].startswith("The driver says nothing. When last heard, the limb was")
    assert limb in first["text"]
    assert "close the valve at the air supply" in first["advice"]
    assert first["since"] == pytest.approx(5.1, abs=0.1)
    assert "planner is dead" in second["text"]


def test_a_driver_that_ended_says_why_and_how_it_was_started(situation: Situation) -> None:
    line = [sys.executable, "-c", "print(flush=True); input()", "port:=/dev/mine"]
    process = subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.readline()  # before it runs, the system may know no command line of it
    here = f"{socket.gethostname()}:{process.pid}"
    situation.put_status(status("/limb/pressure_driver", process=here))
    situation.put_driver(state(PressureState.ARMED))
    words = "no sign of life of the port's process for 1 s"
    situation.put_log(Log(level=20, name="limb.pressure_driver", msg="an ordinary line"))
    situation.put_log(Log(level=50, name="limb.pressure_driver", msg=words))
    situation.put_log(Log(level=50, name="other.pressure_driver", msg="another limb's"))
    process.kill()
    wait_for(lambda: alarms(situation), "the alarm")
    (alarm,) = alarms(situation)
    assert f"its process has ended — {words}. When last heard, the limb was" in alarm["text"]
    assert alarm["advice"].endswith("port:=/dev/mine")
    process.wait()
    situation.put_status(
        status("/limb/pressure_driver", process="elsewhere:1")
    )  # it was started again
    assert alarms(situation) == []


def test_a_fault_and_a_lost_operator_are_told(situation: Situation) -> None:
    situation.put_driver(state(PressureState.FAULT, faults=["supply too low"]))
    (alarm,) = alarms(situation)
    assert "after a fault: supply too low. The limb is without pressure" in alarm["text"]
    # Old readings say nothing of the limb, nor that it was vented.
    situation.put_driver(state(PressureState.FAULT, 9_000.0, faults=["pulled"], telemetry_age=0.9))
    (alarm,) = alarms(situation)
    assert "cannot reach the board: pulled. The limb may keep its pressures" in alarm["text"]
    assert alarm["advice"].startswith("close the valve at the air supply")
    situation.put_driver(state(PressureState.DISARMED))
    situation.put_status(status("/limb/pressure_driver", lost_operator="page"))
    (alarm,) = alarms(situation)
    assert (alarm["level"], alarm["advice"]) == ("notice", "arm to go on")
    situation.put_status(status("/limb/pressure_driver", lost_operator="none"))
    assert alarms(situation) == []


def test_a_touch_is_told_and_a_limb_that_was_vented_for_it(
    situation: Situation, clock: Clock
) -> None:
    situation.put_driver(state(PressureState.TRACKING, 9_000.0))
    situation.put_contact(LimbContact(touched=True, said="0.30 N, at 17.0 cm"))
    (alarm,) = alarms(situation)
    assert (alarm["level"], alarm["text"]) == (
        "notice",
        "Something touches the limb: 0.30 N, at 17.0 cm",
    )
    clock.now += FRESH["contact"] + 0.1
    situation.put_driver(state(PressureState.DISARMED))
    reason = f"{TOUCHED} (the reaction is to vent): 0.30 N, at 17.0 cm; the driver vents"
    situation.put_status(status("/limb/planner", state="vented", reason=reason))
    (alarm,) = alarms(situation)
    assert (alarm["level"], alarm["text"]) == ("danger", f"The limb was vented: {reason}")
    situation.put_driver(state(PressureState.ARMED))
    assert alarms(situation) == []


def test_a_node_of_another_limb_does_not_pass_for_this_ones(
    situation: Situation, clock: Clock
) -> None:
    situation.put_driver(state(PressureState.ARMED))
    situation.put_status(status("/other/planner", learned_plans="theirs"))
    assert situation.value_of("planner", "learned_plans") == ""
    situation.put_status(status("/limb/planner", learned_plans="ours"))
    assert situation.value_of("planner", "learned_plans") == "ours"
    clock.now += DEAD + 0.1
    situation.put_driver(state(PressureState.ARMED))
    (alarm,) = alarms(situation)
    assert "The planner is dead: nothing is heard of it" in alarm["text"]


def test_nodes_that_were_ended_in_order_alarm_nobody(situation: Situation, clock: Clock) -> None:
    situation.put_driver(state(PressureState.DISARMED))
    for name in ("pressure_driver", "planner"):
        situation.put_status(status(f"/limb/{name}", ENDED_IN_ORDER))
    clock.now += 100.0
    (alarm,) = alarms(situation)
    assert alarm["level"] == "notice"
    assert "ended in order, and has vented the limb" in alarm["text"]
    assert [node["state"] for node in situation.snapshot()["nodes"]] == ["ended", "ended"]


def test_a_recorder_that_has_stopped_alarms(situation: Situation) -> None:
    situation.put_driver(state(PressureState.TRACKING))
    situation.put_status(status("/limb/recorder", "fewer than 64 MiB are free", b"\2"))
    (alarm,) = alarms(situation)
    assert alarm["text"] == "The recorder does not record: fewer than 64 MiB are free"


def test_an_experiment_between_two_runs_alarms_nobody(situation: Situation, clock: Clock) -> None:
    situation.put_status(status("/limb/experiment"))
    assert alarms(situation) == []  # it calibrates: no driver has run yet
    situation.put_driver(state(PressureState.DISARMED))
    situation.put_status(status("/limb/pressure_driver", ENDED_IN_ORDER))
    clock.now += 1.0
    assert alarms(situation) == []
    clock.now += DEAD
    (first, second) = alarms(situation)
    assert "The experiment is dead" in first["text"]
    assert "ended in order" in second["text"]


def test_a_node_is_started_again_as_people_start_it() -> None:
    words = [
        "/w/.venv/bin/python",
        "/w/install/der_planner/lib/der_planner/planner",
        "-p",
        "a:=b c",
    ]
    assert as_typed(words) == "scripts/ros2 run der_planner planner -p 'a:=b c'"
    assert as_typed(["sleep", "60"]) == "sleep 60"


def test_what_is_missing_of_a_graph_is_named_with_the_command(situation: Situation) -> None:
    situation.put_status(status("/limb/planner"))
    situation.put_status(status("/other/recorder"))
    starts = situation.snapshot()["missing"]
    assert [line.split()[-1] for line in starts] == [
        "pressure_driver", "apriltag_tracker", "recorder",
    ]  # fmt: skip
    situation.put_status(status("/limb/experiment"))  # which starts the others
    assert situation.snapshot()["missing"] == []
