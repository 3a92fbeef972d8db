"""What people write into a motion command, and what the page says that the planner makes of it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from statuses import status

from der_msgs.msg import MotionCommand
from der_planner.page import commands
from der_planner.page.commands import Answer, Commands
from der_planner.page.forms import FormError, read_mounting, read_number
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
        page = Commands(self, self.situation, 2)  # type: ignore[arg-type]
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
