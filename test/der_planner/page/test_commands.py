"""What people ask of the page, what it says that came of it, and the guide that sets a rig up."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from statuses import status

from der_msgs.msg import LimbState, MotionCommand, PressureState
from der_planner.page import commands
from der_planner.page.commands import Answer, Commands
from der_planner.page.forms import FormError, read_mounting, read_number
from der_planner.page.setup_guide import SetupGuide, Step
from der_planner.page.situation import Situation


class Graph:
    """Stands in for the page's node; ``say`` is what the planner says when it hears a command."""

    def __init__(self, say: Callable[[str], dict[str, str]]) -> None:
        self.situation = Situation()
        self._say = say
        self.listeners = ["planner", "recorder"]

    def create_client(self, *_: object) -> None:
        return None

    def create_publisher(self, *_: object) -> Any:
        return SimpleNamespace(topic_name="command", publish=self._hear)

    def get_subscriptions_info_by_topic(self, _: str) -> list[Any]:
        return [SimpleNamespace(node_name=name) for name in self.listeners]

    def _hear(self, command: MotionCommand) -> None:
        self.situation.put_status(status("/limb/planner", **self._say(command.plan_id)))

    def play(self) -> Answer:
        page = Commands(self, self.situation)  # type: ignore[arg-type]
        return asyncio.run(page.play(MotionCommand(motion="star", model="der")))


def test_a_refusal_is_told_with_its_reason() -> None:
    said = "the driver is DISARMED: arm the driver, then play the plan again"
    answer = Graph(lambda plan_id: {"last_refusal": f"plan {plan_id}: {said}"}).play()
    assert answer == Answer(False, f"refused: {said}")


def test_what_the_planner_took_is_said_to_be_planned() -> None:
    answer = Graph(lambda plan_id: {"plan_id": plan_id, "last_refusal": ""}).play()
    assert answer == Answer(True, "the planner plans star with der")


def test_silence_is_no_success(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "PATIENCE", 0.1)
    answer = Graph(lambda _: {"plan_id": "another", "last_refusal": "plan old: too far"}).play()
    assert not answer.success
    assert "has not answered" in answer.message
    nobody = Graph(lambda _: {})
    nobody.listeners = ["recorder"]
    assert "no planner listens" in nobody.play().message


@pytest.mark.parametrize(("text", "value"), [("12,5", 12.5), (" 2.5 ", 2.5), ("0", 0.0), (3, 3.0)])
def test_numbers_are_read_as_people_write_them(text: object, value: float) -> None:
    assert read_number(text, 0.0, 100.0) == value


@pytest.mark.parametrize("text", ["", None, "1,000.5", "1_0", "nan", "inf", "-1", "101", "ten"])
def test_what_is_no_number_is_refused_with_the_range(text: object) -> None:
    with pytest.raises(FormError, match="from 0 to 100"):
        read_number(text, 0.0, 100.0)
    # A thousand in one country, and one in another.
    with pytest.raises(FormError, match="no mark of thousands"):
        read_number("1,000", 0.0, 10_000.0)


def test_mountings_are_names_or_degrees() -> None:
    assert read_mounting(None) == ""
    assert read_mounting("hanging") == "hanging"
    assert float(read_mounting("12,5°")) == 12.5
    with pytest.raises(FormError, match="upside down"):
        read_mounting("upside down")


VENTED = (12.0, -40.0)
"""Differential pressures [Pa] of a limb that is vented, as its sensors have it."""


class GuidedSetup:
    """What the page hears, and the guide's steps."""

    def __init__(self) -> None:
        self.now = 0.0
        self.situation = Situation(lambda: self.now)
        self.guide = SetupGuide(2)

    def drive(self, pressures: tuple[float, ...], telemetry_age: float = 0.05, **what: Any) -> None:
        """Let the driver say what it does and measures [Pa]."""
        message = PressureState(measured_differential=pressures, telemetry_age=telemetry_age)
        for name, value in what.items():
            setattr(message, name, value)
        self.situation.put_driver(message)

    def plan_for(self, limb: str, identified: str) -> None:
        """Let the planner say for which limb it plans, and when that was identified."""
        self.situation.put_status(status("/limb/planner", limb=limb, limb_identified=identified))

    def steps(self, problem: str = "", calibrated: bool = True) -> list[Step]:
        return self.guide.steps(self.situation.snapshot(), problem, calibrated)

    def done(self) -> list[bool]:
        return [step.done for step in self.steps()]


def test_nothing_is_done_before_anything_is_heard() -> None:
    steps = GuidedSetup().steps("no calibration yet", calibrated=False)
    assert not any(step.done for step in steps)
    assert all(step.seen and step.advice for step in steps)


def test_a_running_rig_passes_until_it_falls_silent() -> None:
    rig = GuidedSetup()
    rig.drive(VENTED)
    rig.situation.put_limb(LimbState(valid=True))
    rig.plan_for("a name", "2026-02-01, bags/run")
    assert rig.done() == [True, True, False, True, True, True, False, True, True]
    rig.now = 6.0
    assert rig.done() == [False, False, False, True, True, False, False, False, False]


def test_each_chamber_counts_only_if_it_is_driven_alone() -> None:
    rig = GuidedSetup()
    for measured in ((5e3, 5e3), (2e3, 0.0), (float("nan"), 5e3)):
        rig.drive(measured, mode=2)
        rig.steps()
    assert "segment 0 left" in rig.steps()[2].seen
    assert "segment 1 left" not in rig.steps()[2].seen
    for measured in ((5e3, 0.0), (-5e3, 200.0), (0.0, -4e3)):
        rig.drive(measured, mode=2)
        rig.steps()
    assert rig.steps()[2].done


@pytest.mark.parametrize("limit", [4e3, 250e3])
def test_chambers_of_other_limbs_count_at_the_same_share_of_the_drivers_limit(limit: float) -> None:
    rig = GuidedSetup()
    rig.situation.put_status(status("/limb/pressure_driver", pressure_limit_pa=f"{limit:g}"))
    rig.drive((0.04 * limit, 0.0))
    assert rig.steps()[1].done
    for measured in ((0.12, 0.0), (0.2, 0.05), (-0.13, 0.0), (0.0, 0.2)):
        rig.drive(tuple(share * limit for share in measured), mode=2)
        rig.steps()
    seen = rig.steps()[2].seen
    assert "segment 0 left" in seen
    assert "segment 1 right" in seen
    assert "segment 0 right" not in seen
    assert "segment 1 left" not in seen


def test_pressure_that_stays_and_a_limb_that_nobody_identified_are_no_success() -> None:
    rig = GuidedSetup()
    rig.drive((1500.0, 0.0))
    rig.plan_for("our limb", "")
    steps = rig.steps()
    assert not steps[1].done
    assert "1.50 kPa" in steps[1].seen
    assert not steps[7].done
    assert not steps[8].done
    rig.drive(VENTED, mode=1)
    assert not rig.steps()[1].done
    rig.drive(VENTED, telemetry_age=float("nan"))
    assert "never been heard" in rig.steps()[0].seen


@pytest.mark.parametrize(("plan", "step"), [("check-12ab", 6), ("calibration-12ab34cd", 7)])
def test_a_run_is_seen_while_and_after_it_is_played(plan: str, step: int) -> None:
    rig = GuidedSetup()
    rig.drive(VENTED, mode=2, plan_id=plan)
    assert (rig.steps()[step].done, rig.steps()[step].seen) == (False, "one is being played")
    rig.drive(VENTED)
    assert rig.steps()[step].done


def test_with_motion_capture_no_camera_is_asked_for() -> None:
    rig = GuidedSetup()
    rig.situation.put_status(status("/limb/pose_tracker"))
    steps = rig.steps("no calibration yet", calibrated=False)
    assert [step.done for step in steps[3:6]] == [True, True, False]
    assert "motion capture" in steps[3].seen
