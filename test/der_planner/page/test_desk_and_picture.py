"""One operator at a time, and pictures no faster than asked for."""

from __future__ import annotations

import pytest

from der_planner.page.operators import Desk
from der_planner.page.picture import LOOKING, PictureFeed


def test_one_commands_and_others_watch() -> None:
    lost: list[str] = []
    desk = Desk(lost.append)
    assert desk.take("a")
    assert not desk.take("b")
    assert desk.may_command("a")
    assert not desk.may_command("b")
    desk.disconnected("b")
    assert desk.may_command("a")
    assert not lost
    desk.disconnected("a")
    assert lost == ["a"]
    assert desk.take("b")
    desk.leave("b")
    desk.disconnected("b")
    assert lost == ["a"]
    assert desk.operator is None


def test_a_window_that_is_loaded_anew_still_commands() -> None:
    lost: list[str] = []
    desk = Desk(lost.append)
    desk.connected("a", "tab 1")
    desk.connected("b", "tab 2")
    assert desk.take("a")
    desk.connected("c", "tab 2")
    assert desk.may_command("a")
    desk.connected("d", "tab 1")
    assert desk.may_command("d")
    assert not desk.may_command("a")
    desk.disconnected("a")
    assert not lost
    desk.disconnected("d")
    assert lost == ["d"]


@pytest.mark.parametrize("camera_rate", [30.0, 25.0, 10.0])
def test_pictures_keep_their_rate(camera_rate: float) -> None:
    now = 0.0
    feed = PictureFeed(15.0, clock=lambda: now)
    feed.take(0)
    taken = 0
    for frame in range(int(camera_rate)):
        now = frame / camera_rate
        taken += feed.due()
    assert min(camera_rate, 15.0) - 3 <= taken <= 16
    now += LOOKING + 0.1
    assert not feed.due()
