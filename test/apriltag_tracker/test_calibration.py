from __future__ import annotations

import dataclasses
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from pictures import image_message
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image

from apriltag_tracker.camera import CameraPose, Intrinsics, calibration, project
from apriltag_tracker.camera.calibration import BoardView, CalibrationError, calibrate_mounting
from apriltag_tracker.commands import calibrate_camera
from apriltag_tracker.commands.calibrate_camera import from_bag, from_topic
from apriltag_tracker.sheets import BoardLayout
from apriltag_tracker.synthetic.camera import SyntheticCamera
from apriltag_tracker.synthetic.shapes import constant_curvature
from apriltag_tracker.tag_map import TagMap
from der_planner.bags.topics import OfferedQos, TopicSpec
from der_planner.bags.writer import BagWriter
from limb_interfaces import qos

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
TOPIC = "/overhead/image"
LAYOUT = BoardLayout()
TRUE = Intrinsics.create(
    640,
    480,
    [620.0, 0.0, 322.7, 0.0, 618.0, 236.4, 0.0, 0.0, 1.0],
    [-0.12, 0.07, 0.0008, -0.0005, 0.0],
)


def poses(count, random, tilt=0.5):
    for k in range(count):
        rotation = cv2.Rodrigues(
            np.array([*random.uniform(-tilt, tilt, 2), random.uniform(-0.3, 0.3)])
        )[0]
        middle = np.array([0.1125, 0.075, 0.0])
        place = np.array([((k % 4) - 1.5) * 0.055, ((k // 4 % 3) - 1.0) * 0.05, 0.33])
        yield rotation, place - rotation @ middle


def corner_views(count, noise, tilt=0.5, seed=0):
    """Views as a perfect corner finder would give them, with noise."""
    random = np.random.default_rng(seed)
    points = np.asarray(LAYOUT.board().getChessboardCorners(), dtype=float)
    views = []
    for k, (rotation, translation) in enumerate(poses(count, random, tilt)):
        pixels = project(TRUE, CameraPose(rotation, translation), points)
        seen = ((pixels > 5) & (pixels < (634, 474))).all(axis=1)
        pixels = pixels + random.normal(0.0, noise, pixels.shape)
        views.append(BoardView(f"view {k}", pixels[seen], points[seen]))
    return views


def board_pictures(count):
    """Pictures of the printed board: first without a lens, large and sharp, then through it."""
    random = np.random.default_rng(1)
    fine, dots, margin = 2, 4000.0, 60
    texture = LAYOUT.board().generateImage((900, 600), marginSize=0, borderBits=1)
    texture = cv2.copyMakeBorder(
        np.asarray(texture), margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255
    )
    to_board = np.array(
        [[1 / dots, 0, (0.5 - margin) / dots], [0, 1 / dots, (0.5 - margin) / dots], [0, 0, 1]]
    )
    focal, wide, high = 620.0 * fine, 900 * fine, 700 * fine
    pinhole = np.array([[focal, 0, wide / 2], [0, focal, high / 2], [0, 0, 1]])
    x, y = np.meshgrid(np.arange(640 * fine), np.arange(480 * fine))
    rays = TRUE.rays((np.stack([x, y], axis=-1).reshape(-1, 2) + 0.5) / fine - 0.5)
    where = (rays * focal + (wide / 2, high / 2)).astype(np.float32)
    where = where.reshape(480 * fine, 640 * fine, 2)
    for rotation, translation in poses(count, random):
        plane = np.column_stack([rotation[:, :2], translation])
        straight = cv2.warpPerspective(
            texture, pinhole @ plane @ to_board, (wide, high), borderValue=128
        )
        large = cv2.remap(straight, where, None, cv2.INTER_LINEAR)
        yield cv2.resize(large, (640, 480), interpolation=cv2.INTER_AREA)


def test_errors_are_as_large_as_their_sigmas_say():
    result = calibration.calibrate_camera(corner_views(24, 0.1), 640, 480)
    matrix = result.intrinsics.matrix
    values = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    true = np.array([620.0, 618.0, 322.7, 236.4])
    assert np.all(np.abs(values - true) < 4.0 * np.array(result.sigma))
    assert result.rms == pytest.approx(0.1 * np.sqrt(2.0), rel=0.1)
    assert result.left_out == {}


def test_a_spoilt_picture_is_left_out_by_name():
    views = corner_views(20, 0.1)
    random = np.random.default_rng(5)
    spoilt = views[7].pixels + random.normal(0.0, 4.0, views[7].pixels.shape)
    views[7] = dataclasses.replace(views[7], pixels=spoilt)
    result = calibration.calibrate_camera(views, 640, 480, unseen=["dark.png"])
    assert set(result.left_out) == {"view 7", "dark.png"}
    assert result.rms < 0.2


@pytest.mark.parametrize(
    ("count", "tilt", "advice"),
    [(0, 0.5, "--columns"), (5, 0.5, "tilted by 20"), (12, 0.01, "same")],
)
def test_pictures_that_tell_too_little_are_refused_with_advice(count, tilt, advice):
    with pytest.raises(CalibrationError, match=advice):
        calibration.calibrate_camera(corner_views(count, 0.1, tilt), 640, 480)


def test_a_corner_of_the_picture_without_corners_is_told():
    views = corner_views(24, 0.1)
    left = []
    for view in views:
        seen = view.pixels[:, 0] < 300
        left.append(dataclasses.replace(view, pixels=view.pixels[seen], points=view.points[seen]))
    seen_by_many = [view for view in left if len(view.pixels) >= 12]
    result = calibration.calibrate_camera(seen_by_many, 640, 480)
    assert result.covered < 0.7


def test_mounting_is_measured_on_the_straight_limb(config, tags, model):
    wrong = tuple(
        dataclasses.replace(tag, offset=(4e-4 * k, -3e-4 * k, 0.01 * k))
        for k, tag in enumerate(tags.limb)
    )
    camera = SyntheticCamera(model, dataclasses.replace(tags, limb=wrong), seed=4)
    straight = constant_curvature(tags.segment_lengths, [0.0, 0.0])
    images = [camera.frame(straight).image for _ in range(6)]
    result = calibrate_mounting(images, tags, model.intrinsics)
    for tag in wrong:
        assert result.offsets[tag.id] == pytest.approx(tag.offset, abs=1e-3)
        assert result.offsets[tag.id][:2] == pytest.approx(tag.offset[:2], abs=3e-5)
    text = calibration.with_offsets((config / "tags.yaml").read_text(), result)
    again = TagMap.from_dict(yaml.safe_load(text))
    assert text.startswith("# Where every AprilTag")
    for read, tag in zip(again.limb, wrong, strict=True):
        assert read.offset == pytest.approx(tag.offset, abs=1e-3)
    assert dataclasses.replace(again, limb=tags.limb) == tags
    dumped = yaml.safe_dump(yaml.safe_load(text))  # one key a line, as programs write them
    assert TagMap.from_dict(yaml.safe_load(calibration.with_offsets(dumped, result))) == again


def test_mounting_without_fixed_tags_names_the_cause(tags, model):
    blank = [np.zeros((720, 1280), np.uint8)]
    with pytest.raises(CalibrationError, match="no fixed tag"):
        calibrate_mounting(blank, tags, model.intrinsics)


def test_mounting_pictures_of_another_size_are_named_in_one_line(tmp_path, call, model):
    lens = tmp_path / "camera.yaml"
    model.intrinsics.to_yaml(lens)
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((480, 640), np.uint8))
    words = ("mounting", tmp_path, "--calibration", lens, "--out", tmp_path / "tags.yaml")
    code, _, complaint = call(calibrate_camera, *words)
    assert code == 1
    assert "640 x 480 px but the calibration is for 1280 x 720" in complaint


@pytest.mark.slow
def test_the_script_calibrates_a_folder_of_pictures(tmp_path):
    for k, image in enumerate(board_pictures(12)):
        cv2.imwrite(str(tmp_path / f"{k:02d}.png"), image)
    cv2.imwrite(str(tmp_path / "99.png"), np.full((480, 640), 90, np.uint8))
    script, out = SCRIPTS / "calibrate_camera.py", tmp_path / "camera.yaml"
    words = [sys.executable, script, "intrinsics", tmp_path, "--out", out]
    said = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    assert "left out: 99.png" in said
    lens = Intrinsics.from_yaml(out)
    assert np.abs(lens.matrix - TRUE.matrix).max() < 3.0
    # What counts: rays over the whole picture.
    x, y = np.meshgrid(np.linspace(40, 600, 9), np.linspace(40, 440, 7))
    grid = np.column_stack([x.ravel(), y.ravel()])
    assert np.abs(lens.rays(grid) - TRUE.rays(grid)).max() < 4e-3


def test_pictures_come_from_a_bag(tmp_path):
    pictures = np.random.default_rng(0).integers(0, 256, (6, 48, 64), dtype=np.uint8)
    bag = BagWriter(tmp_path / "bag")
    spec = TopicSpec.installed(TOPIC, "sensor_msgs/msg/Image", (OfferedQos(),))
    for second, picture in enumerate(pictures):
        stamp = second * 1_000_000_000
        bag.write(spec, stamp, stamp, serialize_message(image_message(picture, stamp)))
    bag.close()
    read = [picture for _, picture in from_bag(tmp_path / "bag", TOPIC, every=1.5)]
    assert np.array_equal(read, pictures[::2])


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["intrinsics", "--out", "x.yaml"], "--topic or --bag"),
        (["intrinsics", "--bag", "/nowhere.mcap", "--out", "x.yaml"], "/nowhere.mcap"),
        (["mounting", "--calibration", "/nowhere.yaml", "--out", "x.yaml"], "/nowhere.yaml"),
        (["intrinsics", "none", "--out", "."], "cannot be written: Is a directory"),
        (["intrinsics", "none", "--out", "missing/camera.yaml"], "cannot be written: No such file"),
        (["intrinsics", "none", "--out", "/proc/camera.yaml"], "cannot be written"),
    ],
)
def test_mistakes_are_named_in_one_line(tmp_path, monkeypatch, call, arguments, named):
    monkeypatch.chdir(tmp_path)
    code, _, complaint = call(calibrate_camera, *arguments)
    assert code == 1
    assert named in complaint
    assert len(complaint.splitlines()) == 1


@pytest.mark.graph
def test_pictures_come_from_a_running_camera(graph, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(graph.domain_id))
    publisher = graph.client.node.create_publisher(Image, TOPIC, qos.SENSOR_DATA)
    picture = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)
    ended = threading.Event()

    def show() -> None:
        while not ended.wait(0.02):
            publisher.publish(image_message(picture))

    camera = threading.Thread(target=show)
    camera.start()
    try:
        read = list(from_topic(TOPIC, 2, every=0.1))
    finally:
        ended.set()
        camera.join()
    assert [name for name, _ in read] == ["picture 1", "picture 2"]
    assert all(np.array_equal(seen, picture) for _, seen in read)
