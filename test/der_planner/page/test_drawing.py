"""Drawing a path over pictures: what is reachable, previews, kept drawings, and the pictures."""

from __future__ import annotations

import asyncio
import json
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from nicegui import Client
from nicegui.page import page

from apriltag_tracker.camera import CameraPose, Intrinsics
from apriltag_tracker.camera.pinhole import project
from apriltag_tracker.detection import Tag
from apriltag_tracker.tag_map import TagMap
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
from der_planner.page.picture import LOOKING, Overlay, PictureFeed
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


TAG_MAP = Path(__file__).parents[3] / "src" / "apriltag_tracker" / "config" / "tags.yaml"


@pytest.mark.parametrize("camera_rate", [30.0, 25.0, 10.0])
def test_pictures_keep_their_rate_while_somebody_looks(camera_rate: float) -> None:
    now = 0.0
    feed = PictureFeed(15.0, clock=lambda: now)
    assert not feed.due()
    assert not feed.has_newer(0)
    taken = 0
    for frame in range(int(camera_rate)):
        now = frame / camera_rate
        taken += feed.due()
    assert min(camera_rate, 15.0) - 3 <= taken <= 16
    now += LOOKING + 0.1
    assert not feed.due()


def test_a_small_window_gets_a_small_file_that_is_made_once() -> None:
    feed = PictureFeed(15.0)
    feed.put(5, np.random.default_rng(0).integers(0, 255, (720, 1280), dtype=np.uint8))
    whole, half = feed.take(), feed.take(shown=700)
    assert half.size == whole.size == (1280, 720)  # what is drawn over it is in the camera's pixels
    shapes = [
        cv2.imdecode(np.frombuffer(one.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE).shape
        for one in (whole, half)
    ]
    assert shapes == [(720, 1280), (360, 640)]
    assert feed.take(shown=640) is half
    assert feed.take(shown=2000) is whole


def test_pixels_become_metres_where_they_are_drawn() -> None:
    tags, now = TagMap.from_yaml(str(TAG_MAP)), 0.0
    overlay = Overlay(tags, clock=lambda: now)
    pixels = np.array([[500.0, 300.0], [700.0, 420.0]])
    assert overlay.on_plane(pixels) is None
    assert overlay.pixels_of(pixels) == []
    camera = Intrinsics.create(
        1280, 720, [1400, 0, 640, 0, 1400, 360, 0, 0, 1], [-0.1, 0.05, 0, 0, 0], "plumb_bob"
    )
    pose = CameraPose.looking_down((0.12, 0.0, 0.8), turn=0.2, tilt=(0.05, -0.03))
    seen = [
        Tag(entry.id, project(camera, pose, entry.corners()), np.eye(8) * 1e-4, 0.01)
        for entry in tags.world
    ]  # fmt: skip
    overlay.put_camera(camera)
    overlay.put_tags(1, seen)
    on_plane = overlay.on_plane(pixels)
    assert on_plane is not None
    height = max(tag.height for tag in tags.limb)
    back = project(camera, pose, np.column_stack([on_plane, np.full(2, height)]))
    np.testing.assert_allclose(back, pixels, atol=0.5)
    np.testing.assert_allclose(overlay.pixels_of(on_plane), pixels, atol=0.2)
    overlay.put_shape("planned", on_plane)
    broken = np.vstack([on_plane, [[math.nan, 0.1], [0.1, math.inf]]])
    overlay.put_shape("estimate", broken)
    shown = overlay.at(1, (math.nan, 0.0))  # what is nowhere is left out: it is no JSON either
    np.testing.assert_allclose(shown["estimate"], pixels, atol=0.2)
    assert shown["reference"] is None
    now = 1.0
    shown = overlay.at(1, None)
    assert (shown["estimate"], shown["planned"]) == ([], [])  # nobody plans or corrects any more

    # A picture that the tracker says nothing of shows neither limb nor tags of an earlier one.
    overlay.put_limb(1, np.vstack([[0.0, 0.0], on_plane[0]]), on_plane[:1])
    near, far = overlay.at(200_000_000, None), overlay.at(2_000_000_000, None)
    np.testing.assert_allclose(near["tip"], pixels[0], atol=0.2)
    assert len(near["tags"]) == len(seen)
    assert (far["tip"], far["curve"], far["tags"]) == (None, [], [])
    assert "tracker" in far["problem"]
