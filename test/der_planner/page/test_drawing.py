"""Drawing a path: what is reachable, previews, kept drawings."""

from __future__ import annotations

import asyncio
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from nicegui import Client
from nicegui.page import page

from der_msgs.msg import MotionCommand
from der_planner.limb import Limb, LimbError, Load
from der_planner.model import ArcModel
from der_planner.page.drawing import (
    DrawingError,
    DrawingFolder,
    Previewer,
    drawn_pixels,
    preview,
    reachable_region,
)
from der_planner.page.drawing_panel import DrawingPanel, summary
from der_planner.planning import PathLimits, Workspace, planner

LIMB = Limb.default()
ARCS = ArcModel(LIMB)
SPACE = Workspace(ARCS)


def test_the_region_holds_what_the_tip_reaches_and_nothing_else() -> None:
    outlines = reachable_region(LIMB)
    poses = np.random.default_rng(2).uniform(SPACE.low, SPACE.high, (300, 2))

    def inside(point: np.ndarray, margin: float) -> bool:
        scaled = [np.float32(outline) for outline in outlines]
        return any(
            cv2.pointPolygonTest(outline, (float(point[0]), float(point[1])), True) > -margin
            for outline in scaled
        )

    assert all(inside(tip, 1.5e-3) for tip in ARCS.tip(poses))
    for point in np.random.default_rng(3).uniform((-0.1, -0.3), (0.3, 0.3), (60, 2)):
        if inside(point, 0.0):
            assert SPACE.distance_to_reach(point, [0.3, 0.3]) < 1.5e-3


def test_a_load_decides_what_is_reached_and_what_draws() -> None:
    previewer = Previewer(LIMB, PathLimits(), carried=Load(0.01))
    assert previewer.limb_under(Load()) == LIMB.carrying(0.01)
    assert previewer.limb_under(Load(0.02, 0.1, "hanging")) == LIMB.mounted("hanging").carrying(
        0.02, 0.1
    )
    assert previewer.limb_under(Load(0.0, 0.1, "90")).payload == (
        0.01,
        0.0,
    )  # as the planner has it
    lying, sideways = (previewer.region(Load(0.03, 0.0, name)) for name in ("", "sideways"))
    height = [np.ptp(np.vstack(outlines)[:, 1]) for outlines in (lying, sideways)]
    assert height[1] < 0.9 * height[0]  # the weight is lifted on one side
    assert previewer.region(Load(0.03)) is previewer.region(Load(0.03))
    previewer.follow(LIMB.mounted("sideways"))  # as the planner's own limb turns out to be
    assert previewer.region(Load(0.03))[0] == pytest.approx(sideways[0])
    with pytest.raises(LimbError, match="arc_length"):
        previewer.limb_under(Load(0.02, 9.0))


@pytest.mark.parametrize(
    "sent",
    [None, [], "line", [[1, 2]], [[1, 2], [3]], [[1, 2], [3, None]], [[1, 2], [3, 1e400]],
     [[0, 0]] * 20_001, {"x": 1}],
)  # fmt: skip
def test_what_is_no_drawing_is_refused(sent: object) -> None:
    with pytest.raises(DrawingError):
        drawn_pixels(sent)


def test_a_preview_says_what_would_be_played_or_why_not(monkeypatch: pytest.MonkeyPatch) -> None:
    turn = np.linspace(0, 2 * np.pi, 40)
    ring = ARCS.tip([0.9, 0.9]) + 0.03 * np.column_stack([np.cos(turn), np.sin(turn)])
    found = preview(LIMB, ring, PathLimits(), "pcc", "paper")
    assert not found.problem
    assert 0 < found.largest_pressure <= LIMB.pneumatics.pressure_limit
    largest = re.search(r"([\d.]+) mm at most", found.deviation)
    assert 5.0 < float(largest[1]) < 30.0
    text = summary(found)
    assert "leaves what the limb reaches" in text
    assert f"{found.duration:.1f} s" in text
    json.dumps([pose.tolist() for pose in found.poses])
    slow = preview(LIMB, ring, PathLimits(speed=1e-6), "pcc", "paper")
    assert "the longest is 3600 s" in summary(slow)
    hanging = LIMB.mounted("hanging").carrying(0.1)
    heavy = preview(hanging, ring, PathLimits(), "der", "projected")
    assert not heavy.problem, "the rod takes more than the arcs by which the path was sought"
    assert 0.95 < heavy.largest_pressure / LIMB.pneumatics.pressure_limit <= 1.0
    monkeypatch.setattr(planner, "_SEARCHES", 1)
    heavy = preview(hanging, ring, PathLimits(), "der", "projected")
    assert "kPa are allowed" in heavy.problem
    assert np.linalg.norm(ring - heavy.place, axis=1).min() < 0.1  # on the way there


@pytest.mark.parametrize("name", ["../up", "a/b", ".hidden", "/etc/passwd", "star\x00", "Über 1"])
def test_a_name_stays_in_its_folder(tmp_path: Path, name: str) -> None:
    drawings = DrawingFolder(tmp_path / "kept")
    points = np.array([[0.1, 0.2], [0.12, 0.21]])
    kept = drawings.save(name, points).stem
    assert drawings.names() == [kept]
    assert [path.parent for path in tmp_path.rglob("*.csv")] == [tmp_path / "kept"]
    np.testing.assert_allclose(drawings.load(kept), points, atol=1e-6)
    with pytest.raises(DrawingError, match="already"):
        drawings.save(name, points)


def test_files_put_there_by_hand_are_found_and_missing_ones_named(tmp_path: Path) -> None:
    (tmp_path / "by hand.csv").write_text("x [cm], y [cm]\n10, 20\n12, 21\n")
    drawings = DrawingFolder(tmp_path)
    assert drawings.names() == ["by hand"]
    np.testing.assert_allclose(drawings.load("by hand"), [[0.1, 0.2], [0.12, 0.21]], atol=1e-6)
    with pytest.raises(DrawingError, match="no drawing 'none'"):
        drawings.load("none")
    with pytest.raises(DrawingError):
        drawings.save("..", np.zeros((2, 2)))


@pytest.mark.parametrize("sent", [[[1.0, 2.0]], [], [[1.0, 2.0], [3.0, 4.0]]])
def test_a_drawing_that_has_left_the_picture_is_not_played(
    sent: list[list[float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a tap, a line that was broken off, and one where the camera's pose is not known."""
    monkeypatch.setattr(Client, "run_javascript", lambda *_: None)
    parts: Any = SimpleNamespace(
        drawings=DrawingFolder(Path("nowhere")), overlay=SimpleNamespace(on_plane=lambda _: None)
    )
    drawn: Any = SimpleNamespace(args={"points": sent})
    with Client(page("/")) as client:
        panel = DrawingPanel(client, parts, MotionCommand, lambda: None)
        panel._switch.value, panel._playable = True, MotionCommand()
        assert panel.ready
        asyncio.run(panel._on_drawn(drawn))
        assert not panel.ready
