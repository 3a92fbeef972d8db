"""What the page says is as old as it says, and never newer."""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import subprocess
import sys

import pytest
from geometry_msgs.msg import Point
from statuses import status
from waiting import Clock, wait_for

from der_msgs.msg import LimbState, PressurePlan, PressureState
from der_planner.page.situation import DEAD, FORGOTTEN, FRESH, LATE, SILENT, Situation
from limb_interfaces.stamps import stamp_from_nanoseconds


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
