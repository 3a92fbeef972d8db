"""What the page says is as old as it says, never newer; alarms say what to do, worst first."""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import subprocess
import sys
from typing import Any

import pytest
from geometry_msgs.msg import Point
from rcl_interfaces.msg import Log
from statuses import status
from waiting import Clock, wait_for

from der_msgs.msg import LimbContact, LimbState, PressurePlan, PressureState
from der_planner.page.situation import DEAD, FORGOTTEN, FRESH, LATE, SILENT, Situation, as_typed
from limb_interfaces.diagnostics import ENDED_IN_ORDER, TOUCHED
from limb_interfaces.stamps import stamp_from_nanoseconds


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def situation(clock: Clock) -> Situation:
    return Situation(clock)


def driver(mode: int = 5, age: float = 0.1) -> PressureState:
    nan = float("nan")
    return PressureState(
        mode=mode, faults=["no telemetry"], commanded_differential=[12_000.0, 0.0],
        measured_differential=[nan, 250.0], supply_pressure=nan, telemetry_age=age,
    )  # fmt: skip


def view(stamp: int, tip: tuple[float, float] = (0.2, 0.05), valid: bool = True) -> LimbState:
    message = LimbState(valid=valid, tip=Point(x=tip[0], y=tip[1]), bend_angle=[math.pi / 4, 0.0])
    message.header.stamp = stamp_from_nanoseconds(stamp)
    return message


def test_data_grow_old(situation: Situation, clock: Clock) -> None:
    assert situation.driver_mode == ""
    situation.put_driver(driver())
    assert situation.snapshot()["sources"]["driver"]["fresh"]
    assert situation.driver_mode == "fault"
    clock.now += FRESH["driver"] + 0.01
    assert situation.driver_mode == SILENT
    source = situation.snapshot()["sources"]["driver"]
    assert not source["fresh"]
    assert source["age"] == pytest.approx(FRESH["driver"], abs=0.02)
    assert max(FRESH.values()) < 1.0


def test_numbers_come_in_kilopascal_and_unknown_ones_as_null(situation: Situation) -> None:
    situation.put_driver(driver())
    text = json.dumps(situation.snapshot(), allow_nan=False)
    values = json.loads(text)["driver"]
    assert values["mode"] == "fault"
    assert values["commanded_kpa"] == [12.0, 0.0]
    assert values["measured_kpa"] == [None, 0.25]
    assert values["supply_kpa"] is None
    for silent in (0.6, math.nan):  # the board's last readings are none of now
        situation.put_driver(driver(age=silent))
        assert situation.snapshot()["driver"]["measured_kpa"] == [None, None]
        assert situation.snapshot()["limb_is"].startswith("under pressure")  # it was told so
    situation.put_driver(driver(mode=17))
    assert situation.snapshot()["driver"]["mode"] == "unknown mode 17"


def test_nodes_turn_late_and_dead(situation: Situation, clock: Clock) -> None:
    def shown() -> list[tuple[str, str]]:
        return [(node["name"], node["state"]) for node in situation.snapshot()["nodes"]]

    situation.put_status(status("/a/b", "running"))
    situation.put_status(status("/limb/recorder", "running"))
    situation.put_status(status("/limb/planner", "refused: too far", b"\1"))
    others = [("/limb/recorder", "ok"), ("/a/b", "ok")]
    assert shown() == [("/limb/planner", "warning"), *others]  # the worst first
    clock.now += LATE + 0.1
    situation.put_status(status("/limb/recorder", "running"))
    situation.put_status(status("/a/b", "running"))
    assert shown() == [("/limb/planner", "late"), *others]
    clock.now += DEAD
    assert shown()[0] == ("/limb/planner", "dead")


def test_strangers_are_forgotten(situation: Situation, clock: Clock) -> None:
    situation.put_status(status("/stranger", "here"))
    situation.put_status(status("/limb/planner", "idle"))
    nodes = situation.snapshot()["nodes"]
    assert [node["name"] for node in nodes] == ["/limb/planner", "/stranger"]
    clock.now += FORGOTTEN + 1.0
    assert [node["name"] for node in situation.snapshot()["nodes"]] == ["/limb/planner"]


def test_a_process_that_ends_or_stops_is_dead_at_once(situation: Situation) -> None:
    """Its last diagnostics are not yet late: the operating system tells."""
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    here = f"{socket.gethostname()}:{process.pid}"

    def state() -> tuple[str, str]:
        (node,) = situation.snapshot()["nodes"]
        return node["state"], node["message"]

    def becomes(wanted: tuple[str, str]) -> None:
        wait_for(lambda: state() == wanted, str(wanted))

    try:
        situation.put_status(status("/limb/planner", "idle", process=here))
        becomes(("ok", "idle"))
        process.send_signal(signal.SIGSTOP)
        becomes(("dead", "its process is stopped"))
        process.send_signal(signal.SIGCONT)
        becomes(("ok", "idle"))
    finally:
        process.kill()
    # Also before anybody has waited for it.
    becomes(("dead", "its process has ended"))
    process.wait()
    assert state() == ("dead", "its process has ended")
    # The node was started again.
    again = f"{socket.gethostname()}:{os.getpid()}"
    situation.put_status(status("/limb/planner", "idle", process=again))
    assert state() == ("ok", "idle")


@pytest.mark.parametrize("identity", ["elsewhere:{ended}", "{host}:{ended}", "", "x", "{host}:-1"])
def test_a_process_that_was_never_seen_here_has_not_ended(
    situation: Situation, identity: str
) -> None:
    """As that of another computer, or of a container of the same name."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    named = identity.format(host=socket.gethostname(), ended=process.pid)
    situation.put_status(status("/limb/planner", "idle", process=named))
    assert situation.snapshot()["nodes"][0]["state"] == "ok"


def test_the_error_is_against_the_reference_at_the_image(situation: Situation) -> None:
    step = 50_000_000
    for index in range(5):  # sent ahead of time, as the planner does
        situation.put_reference(index * step, 0.2, 0.01 * index)
    situation.put_limb(view(stamp=step + step // 2, tip=(0.2, 0.015)))
    assert situation.snapshot()["limb"]["error_cm"] == pytest.approx(0.0, abs=1e-3)
    situation.put_limb(view(stamp=2 * step, tip=(0.203, 0.02)))
    assert situation.snapshot()["limb"]["error_cm"] == pytest.approx(0.3)
    situation.put_limb(view(stamp=99 * step))
    assert situation.snapshot()["limb"]["error_cm"] is None
    situation.put_limb(view(stamp=2 * step, valid=False))
    assert situation.snapshot()["limb"]["error_cm"] is None


def test_no_reference_is_made_up_across_a_pause(situation: Situation) -> None:
    situation.put_reference(0, 0.2, 0.0)
    situation.put_reference(2_000_000_000, 0.2, 0.1)
    assert situation.reference_at(1_000_000_000) is None
    assert situation.reference_at(-1) is None
    situation.put_reference(1_000_000_000, 0.1, 0.0)  # a newer plan
    assert situation.reference_at(2_000_000_000) is None


def test_a_plan_says_what_it_reckons_with(situation: Situation) -> None:
    down = [9.81, 0.0, 0.0]
    plan = PressurePlan(
        motion="opposite_direction", limb="mine", gravity=down, payload=0.02, payload_at=0.12,
        predicted_error=0.0031,
    )  # fmt: skip
    situation.put_plan(plan)
    said = situation.snapshot()["plan"]
    for part in ("opposite", "'mine'", "hanging", "20 g at 12.0 cm", "0.31 cm"):
        assert part in said
    plan.payload = 0.0
    situation.put_plan(plan)
    assert "carrying" not in situation.snapshot()["plan"]


def state(mode: int, measured: float = 0.0, **fields: Any) -> PressureState:
    return PressureState(
        mode=mode, measured_differential=[measured, 0.0], commanded_differential=[0.0, 0.0],
        **fields,
    )  # fmt: skip


def alarms(situation: Situation) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = situation.snapshot()["alarms"]
    return found


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
    ("kept", "limb"), [(9_000.0, "under pressure (9.0 kPa)"), (900.0, "without pressure")]
)
def test_a_pair_that_does_not_vent_is_under_pressure_though_it_does_not_differ(
    situation: Situation, kept: float, limb: str
) -> None:
    message = state(PressureState.FAULT, 0.0)
    message.commanded_chamber = [101_000.0] * 4
    message.measured_chamber = [101_000.0 + gauge for gauge in (kept, kept, 0.0, 0.0)]
    situation.put_driver(message)
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
