"""The camera calibration reads its pictures from bags and from running cameras, too."""

from __future__ import annotations

import array
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from apriltag_tracker.camera import Intrinsics
from apriltag_tracker.commands import calibrate_camera

sys.path.insert(0, str(Path(__file__).parent))
from test_calibration import TRUE, board_pictures

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "calibrate_camera.py"
TOPIC = "/overhead/image"


def calibrate(out: Path, *arguments: str, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, SCRIPT, "intrinsics", *arguments, "--out", out],
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_bag_of_pictures(tmp_path: Path):
    types = get_typestore(Stores.ROS2_JAZZY)
    Time = types.types["builtin_interfaces/msg/Time"]
    Header = types.types["std_msgs/msg/Header"]
    Image = types.types["sensor_msgs/msg/Image"]
    bag = tmp_path / "bag"
    with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        link = writer.add_connection(TOPIC, Image.__msgtype__, typestore=types)
        for k, picture in enumerate(board_pictures(12)):
            stamp = (k + 1) * 1_000_000_000
            header = Header(Time(k + 1, 0), "camera")
            high, wide = picture.shape
            message = Image(header, high, wide, "mono8", 0, wide, picture.ravel())
            writer.write(link, stamp, types.serialize_cdr(message, Image.__msgtype__))
    out = tmp_path / "camera.yaml"
    process = calibrate(out, "--bag", str(bag), "--topic", TOPIC, "--every", "0.5")
    said, complaint = process.communicate(timeout=120)
    assert process.returncode == 0, complaint
    assert said.count("corners\n") == 12
    assert np.abs(Intrinsics.from_yaml(out).matrix - TRUE.matrix).max() < 3.0


@pytest.mark.parametrize(
    ("out", "reason"),
    [
        (".", "is a folder: name a file"),
        ("missing/camera.yaml", "is no folder"),
        ("/proc/camera.yaml", "cannot be written"),
    ],
)
def test_a_place_that_cannot_be_written_is_refused_before_pictures_are_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any, out: str, reason: str
):
    given = ["intrinsics", "no_pictures_here", "--out", str(tmp_path / out)]
    monkeypatch.setattr(sys, "argv", ["calibrate_camera.py", *given])
    assert calibrate_camera.main() == 1
    said, complaint = capsys.readouterr()
    assert reason in complaint
    assert len(complaint.splitlines()) == 1
    assert said == ""


@pytest.mark.graph
def test_a_running_camera(graph, tmp_path: Path):
    from sensor_msgs.msg import Image

    from limb_interfaces import qos

    publisher = graph.client.node.create_publisher(Image, TOPIC, qos.SENSOR_DATA)
    pictures = list(board_pictures(12))
    out = tmp_path / "camera.yaml"
    process = calibrate(
        out, "--topic", TOPIC, "--every", "0.3", "--count", "16",
        ROS_DOMAIN_ID=str(graph.domain_id),
    )  # fmt: skip
    shown = 0

    def show_the_next() -> bool:
        nonlocal shown
        picture = pictures[shown // 3 % len(pictures)]
        shown += 1
        high, wide = picture.shape
        message = Image(height=high, width=wide, encoding="mono8", step=wide)
        message.data = array.array("B", picture.tobytes())
        publisher.publish(message)
        graph.client.spin(0.1)
        return process.poll() is not None

    graph.client.wait_for(show_the_next, 120.0, "the calibration")
    _, complaint = process.communicate()
    assert process.returncode == 0, complaint
    assert "picture 16 of 16" in complaint
    assert np.abs(Intrinsics.from_yaml(out).matrix - TRUE.matrix).max() < 5.0
