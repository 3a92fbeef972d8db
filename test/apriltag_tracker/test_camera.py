"""The camera's model, pictures that are rendered with it, and the map of tags."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
import yaml

from apriltag_tracker.camera import (
    CameraError,
    CameraPose,
    Intrinsics,
    project,
    solve_pose,
)
from apriltag_tracker.synthetic.camera import (
    CameraModel,
    Optics,
    Shape,
    SyntheticCamera,
)
from apriltag_tracker.synthetic.shapes import constant_curvature
from apriltag_tracker.tag_map import MapError, TagMap, WorldTag
from benchmarks.tracker.renderer import BLACK, FULL, WHITE, Scene, draw_patch

MATRIX = [1250.0, 0.0, 642.3, 0.0, 1240.0, 357.1, 0.0, 0.0, 1.0]
PLUMB_BOB = [-0.11, 0.06, 0.0006, -0.0004, 0.01]
RATIONAL = [0.2, -0.1, 0.0006, -0.0004, 0.01, 0.3, -0.05, 0.002]
WIDE = [-0.4, 0.25, 0.0005, -0.0005, -0.09]


def intrinsics(distortion) -> Intrinsics:
    return Intrinsics.create(1280, 720, MATRIX, distortion)


@pytest.mark.parametrize("distortion", [[], PLUMB_BOB, RATIONAL, WIDE])
def test_rays_undo_the_lens_of_opencv(distortion):
    lens = intrinsics(distortion)
    pixels = np.random.default_rng(2).uniform([0, 0], [1280, 720], (200, 2))
    points = np.column_stack([lens.rays(pixels), np.ones(200)])
    still = CameraPose(np.eye(3), np.zeros(3))
    assert np.allclose(project(lens, still, points), pixels, atol=1e-8)


def test_plane_and_projection_are_inverse():
    lens = intrinsics(PLUMB_BOB)
    pose = CameraPose.looking_down((0.1, 0.02, 0.6), -1.5, (0.1, -0.08))
    points = np.random.default_rng(3).uniform(-0.2, 0.2, (40, 2))
    for height in (0.0, 0.03):
        pixels = project(lens, pose, np.column_stack([points, np.full(40, height)]))
        assert np.allclose(pose.onto_plane(lens.rays(pixels), height), points, atol=1e-10)


def test_a_mirrored_map_is_refused():
    lens = intrinsics([])
    pose = CameraPose.looking_down((0.0, 0.0, 0.8), 0.3)
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 4), np.linspace(-0.3, 0.3, 4))
    square = np.column_stack([x.ravel(), y.ravel(), np.zeros(16)])
    pixels = project(lens, pose, square)
    mirrored = square * (1.0, -1.0, 1.0)
    with pytest.raises(CameraError, match=r"from below|no camera pose"):
        solve_pose(lens, mirrored, pixels)


@pytest.mark.parametrize("distortion", [PLUMB_BOB, RATIONAL])
def test_calibration_survives_its_file(tmp_path, distortion):
    lens = intrinsics(distortion)
    lens.to_yaml(tmp_path / "camera.yaml")
    again = Intrinsics.from_yaml(tmp_path / "camera.yaml")
    assert np.array_equal(again.matrix, lens.matrix)
    assert np.array_equal(again.distortion, lens.distortion)
    assert (again.width, again.height) == (1280, 720)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 720, MATRIX, []), "1280|0 x 720"),
        ((1280, 720, MATRIX, [0.0] * 12), "12 distortion"),
        ((1280, 720, MATRIX, [0.1] * 6), "6 distortion"),
        ((1280, 720, MATRIX, [], "equidistant"), "equidistant"),
        ((1280, 720, [np.nan] * 9, []), "not calibrated"),
        ((1280, 720, [0.0] * 9, []), "calibrate_camera"),
    ],
)
def test_impossible_calibrations_are_refused(arguments, message):
    with pytest.raises(CameraError, match=message):
        Intrinsics.create(*arguments)


LETTERS = """image_width: 1280
image_height: 720
camera_matrix: {data: [a, 0, 0, 0, 1, 0, 0, 0, 1]}
distortion_coefficients: {data: []}
"""


@pytest.mark.parametrize("text", ["", "a: 1", "[1, 2", "image_width: x", LETTERS, "é: 1"])
def test_files_that_are_no_calibration_are_named(tmp_path, text):
    path = tmp_path / "camera.yaml"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(CameraError, match=r"camera\.yaml"):
        Intrinsics.from_yaml(path)
    with pytest.raises(CameraError, match="nowhere"):
        Intrinsics.from_yaml(tmp_path / "nowhere.yaml")


@pytest.mark.parametrize(("blur", "speed"), [(0.5, 0.0), (1.2, 0.0), (0.5, 0.6)])
def test_pixels_agree_with_brute_force_sampling(model, tags, blur, speed):
    inks = {"black": FULL * BLACK, "white": FULL * WHITE}
    optics = Optics(noise=0.0, light_fall=0.0, blur=blur, exposure=0.01, **inks)
    camera = SyntheticCamera(model, tags, optics)
    shape = constant_curvature(tags.segment_lengths, [0.5, 0.4])
    motion = np.tile([0.0, speed], (len(shape.heading), 1))
    frame = camera.frame(shape, Shape(shape.arc_length, motion, 0.0 * shape.heading))
    moved = dataclasses.replace(shape, points=shape.points + optics.exposure * motion)
    corners = frame.corners[2]
    middle = corners.mean(axis=0)
    way = camera.frame(moved).corners[2].mean(axis=0) - middle
    left, top = np.floor(middle).astype(int) - 32
    scene = Scene("", blur=blur, smear=np.hypot(*way))
    drawn = FULL * draw_patch(scene, 2, corners - (left, top), 64, np.arctan2(way[1], way[0]))
    # The tag's own square: outside of it the limb's body is drawn in another way.
    own = middle + (0.7 if speed else 1.0) * (corners - middle) - (left, top)
    mask = np.zeros((64, 64), dtype=np.uint8)
    cv2.fillConvexPoly(mask, np.round(own).astype(np.int32), 1)
    gap = (frame.image[top : top + 64, left : left + 64] - drawn)[mask > 0]
    assert np.abs(gap).max() < 6.0
    assert np.sqrt(np.mean(gap**2)) < 1.2
    assert abs(gap.mean()) < 0.3


def test_pictures_repeat_with_their_seed(model, tags):
    shape = constant_curvature(tags.segment_lengths, [0.2, 0.1])
    first, second, other = (SyntheticCamera(model, tags, seed=seed) for seed in (5, 5, 6))
    picture = first.frame(shape).image
    assert np.array_equal(picture, second.frame(shape).image)
    assert not np.array_equal(picture, other.frame(shape).image)
    assert not np.array_equal(picture, first.frame(shape).image)


def test_shapes_are_interpolated_and_continued(tags):
    shape = constant_curvature(tags.segment_lengths, [0.6, -0.4], points=9)
    exact = constant_curvature(tags.segment_lengths, [0.6, -0.4], points=1001)
    for arc_length in (0.03, 0.13, 0.2, 0.244):
        k = int(np.argmin(np.abs(exact.arc_length - arc_length)))
        s = exact.arc_length[k]
        place = shape.at(s)
        assert np.allclose(place[:2], exact.points[k], atol=3e-6)
        assert place[2] == pytest.approx(exact.heading[k], abs=1e-9)
    beyond = shape.at(0.254)
    end, angle = exact.points[-1], exact.heading[-1]
    assert np.allclose(beyond[:2], end + 0.01 * np.array([np.cos(angle), np.sin(angle)]))


def test_a_wrong_camera_file_is_named(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text("schema: 1\nwidth: 10\n")
    with pytest.raises(CameraError, match=r"camera\.yaml"):
        CameraModel.from_yaml(path)
    path.write_text("schema: 7\n")
    with pytest.raises(CameraError, match="schema"):
        CameraModel.from_yaml(path)


@pytest.fixture
def content(config):
    return yaml.safe_load((config / "tags.yaml").read_text())


def test_corners_of_a_turned_tag():
    tag = WorldTag(1, (1.0, 2.0, 0.1), np.pi / 2, 0.2)
    expected = [(1.1, 1.9, 0.1), (1.1, 2.1, 0.1), (0.9, 2.1, 0.1), (0.9, 1.9, 0.1)]
    assert np.allclose(tag.corners(), expected)


def _set(*path, value):
    def change(content):
        place = content
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("schema", value=9), "schema"),
        (_set("family", value="tagCustom48h12"), "tagCustom48h12.*tag36h11, tag36h10"),
        (_set("family", value="tag16h5"), "none of 0 to 29, which tag16h5 has"),
        (_set("limb", "segment_lengths", value=[0.1, -0.1]), "segment_lengths"),
        (_set("limb", "tags", value=[]), "at least one"),
        (_set("limb", "tags", 0, "id", value=700), "700"),
        (_set("limb", "tags", 1, "id", value=True), "id True"),
        (_set("limb", "tags", 0, "hight", value=0.03), "limb tag 0: unknown key 'hight'"),
        (_set("world", "tags", 0, "yaaw", value=1.0), "world tag 100: unknown key 'yaaw'"),
        (_set("world", "tags", value=[]), "world.tags is empty"),
        (_set("limb", "tags", 0, "arc_length", value=0.5), "arc_length 0.5"),
        (_set("limb", "tags", 0, "size", value=0.0), "size"),
        (_set("limb", "tags", 0, "offset", value=[0.0]), "offset"),
        (_set("limb", "tags", 0, "id", value=100), "twice"),
        (_set("limb", "stiff", value=[[0.1, 0.05]]), "stiff"),
        (_set("limb", "stiff", value=[[0.0, 0.1]]), "more than half"),
        (_set("world", "tags", 0, "yaw", value=float("nan")), "yaw"),
    ],
)
def test_impossible_maps_are_refused_by_name(content, change, message):
    change(content)
    with pytest.raises(MapError, match=message):
        TagMap.from_dict(content)


def test_files_are_named(tmp_path):
    with pytest.raises(MapError, match="nowhere"):
        TagMap.from_yaml(tmp_path / "nowhere.yaml")
    path = tmp_path / "tags.yaml"
    path.write_text("[1, 2")
    with pytest.raises(MapError, match="not YAML"):
        TagMap.from_yaml(path)
    path.write_text("schema: 1  # é", encoding="latin-1")
    with pytest.raises(MapError, match=r"tags\.yaml.*utf-8"):
        TagMap.from_yaml(path)
    path.write_text("schema: 2")
    with pytest.raises(MapError, match=r"tags\.yaml.*schema"):
        TagMap.from_yaml(path)
