"""Calibrate the camera with a ChArUco board, or the tags' mounting from the straight limb.

python3 scripts/calibrate_camera.py intrinsics pictures/ --out camera.yaml
python3 scripts/calibrate_camera.py intrinsics --topic /limb/camera/image_raw --out camera.yaml
python3 scripts/calibrate_camera.py intrinsics --bag run.mcap --out camera.yaml
python3 scripts/calibrate_camera.py mounting pictures/ --calibration camera.yaml --out my_tags.yaml

`scripts/make_tags.py board` prints the board. The result is the YAML that ROS's camera drivers read
as camera_info and that the tracker reads with its parameter calibration_file.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.node import Node
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import Image

from apriltag_tracker.camera import CameraError, Intrinsics
from apriltag_tracker.camera.calibration import (
    BoardFinder,
    CalibrationError,
    calibrate_camera,
    calibrate_mounting,
    with_offsets,
)
from apriltag_tracker.camera.images import PICTURES, ImageError, ImageReader, read_picture
from apriltag_tracker.installed import CONFIG
from apriltag_tracker.sheets import SheetError, add_board_arguments, given_board
from apriltag_tracker.tag_map import MapError, TagMap
from limb_interfaces import qos

Picture = tuple[str, NDArray[np.uint8]]


def from_files(paths: list[Path]) -> Iterator[Picture]:
    """Yield the pictures of files and folders."""
    files = [
        file
        for path in paths
        for file in (sorted(path.iterdir()) if path.is_dir() else [path])
        if file.suffix.lower() in PICTURES
    ]
    if not files:
        raise CalibrationError(f"no pictures in {', '.join(str(path) for path in paths)}")
    for file in files:
        yield file.name, read_picture(file)


def from_bag(path: Path, topic: str, every: float) -> Iterator[Picture]:
    """Yield a picture of a bag's image topic every so many seconds."""
    if not path.exists():
        raise CalibrationError(f"there is no bag {path}")
    with contextlib.ExitStack() as stack:
        try:
            bag = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
            reader = stack.enter_context(bag)
        except AnyReaderError as error:
            raise CalibrationError(f"cannot read the bag {path}: {error}") from error
        wanted = [
            link
            for link in reader.connections
            if link.msgtype == "sensor_msgs/msg/Image" and (not topic or link.topic == topic)
        ]
        if not wanted:
            raise CalibrationError(f"no images{f' on {topic}' if topic else ''} in {path}")
        due, images = 0, ImageReader()
        for link, stamp, raw in reader.messages(connections=wanted[:1]):
            if stamp < due:
                continue
            due = stamp + round(every * 1e9)
            picture = images.to_grey(reader.deserialize(raw, link.msgtype))
            yield f"{stamp * 1e-9:.2f} s", picture


def from_topic(topic: str, count: int, every: float) -> Iterator[Picture]:
    """Yield pictures of a live topic: move the board between them."""
    rclpy.init()
    node = Node("calibrate_camera")
    came: list[Image] = []
    images = ImageReader()
    node.create_subscription(Image, topic, came.append, qos.IMAGES)
    try:
        for number in range(count):
            due = time.monotonic() + every
            while time.monotonic() < due:
                rclpy.spin_once(node, timeout_sec=0.1)
            came.clear()
            while not came:
                rclpy.spin_once(node, timeout_sec=0.1)
                if time.monotonic() > due + 10.0:
                    raise CalibrationError(f"no image on {topic} for 10 s: does the camera run?")
            print(f"picture {number + 1} of {count}: move the board", file=sys.stderr, flush=True)
            yield f"picture {number + 1}", images.to_grey(came[-1])
    finally:
        node.destroy_node()
        with contextlib.suppress(Exception):
            rclpy.shutdown()


def pictures(options: argparse.Namespace) -> Iterator[Picture]:
    """Yield pictures from wherever the command line says."""
    if options.bag is not None:
        return from_bag(options.bag, options.topic or "", options.every)
    if options.topic:
        return from_topic(options.topic, options.count, options.every)
    if not options.pictures:
        raise CalibrationError(
            "nothing to calibrate with: give a folder of pictures, --topic or --bag"
        )
    return from_files(options.pictures)


def intrinsics(options: argparse.Namespace) -> None:
    """Calibrate the camera and write the result."""
    finder = BoardFinder(given_board(options))
    views, unseen, size = [], [], None
    for name, image in pictures(options):
        if size is not None and image.shape != size:
            raise CalibrationError(f"{name} has another size than the pictures before")
        size = image.shape
        view = finder.find(image, name)
        print(f"{name}: {f'{len(view.pixels)} corners' if view else 'no board'}", flush=True)
        if view is None:
            unseen.append(name)
        else:
            views.append(view)
    if size is None:
        raise CalibrationError("no picture came")
    result = calibrate_camera(views, size[1], size[0], options.rational, unseen)
    matrix, sigma = result.intrinsics.matrix, result.sigma
    print(
        f"\nfx {matrix[0, 0]:.2f} ± {sigma[0]:.2f}  fy {matrix[1, 1]:.2f} ± {sigma[1]:.2f}  "
        f"cx {matrix[0, 2]:.2f} ± {sigma[2]:.2f}  cy {matrix[1, 2]:.2f} ± {sigma[3]:.2f} px\n"
        f"distortion {np.round(result.intrinsics.distortion, 5).tolist()}\n"
        f"error {result.rms:.3f} px over {result.pictures} pictures, "
        f"corners cover {100 * result.covered:.0f} % of the image"
    )
    for name, why in result.left_out.items():
        print(f"left out: {name}: {why}")
    result.intrinsics.to_yaml(options.out)
    print(f"written to {options.out}")


def mounting(options: argparse.Namespace) -> None:
    """Measure the mounting of the limb tags and write a tag map with it."""
    tags = TagMap.from_yaml(options.tag_map)
    lens = Intrinsics.from_yaml(options.calibration)
    result = calibrate_mounting((image for _, image in pictures(options)), tags, lens)
    print("tag   along [mm]  across [mm]  turn [deg]   scatter [mm, mm, deg]")
    for tag, (along, across, turn) in result.offsets.items():
        spread = result.scatter[tag]
        print(
            f"{tag:3d}  {1e3 * along:10.3f}  {1e3 * across:11.3f}  {np.degrees(turn):10.3f}   "
            f"{1e3 * spread[0]:.3f}, {1e3 * spread[1]:.3f}, {np.degrees(spread[2]):.3f}"
        )
    options.out.write_text(with_offsets(options.tag_map.read_text(), result))
    print(f"written to {options.out}, from {result.pictures} pictures")


def _check_output(path: Path) -> None:
    """Refuse a file that cannot be written before pictures are taken; nothing is left behind.

    Raises:
        CalibrationError: it is a folder, its folder is missing, or there is no right to write.
    """
    present = path.exists()
    try:
        path.open("ab").close()
    except OSError as error:
        raise CalibrationError(f"--out {path} cannot be written: {error.strerror}") from error
    if not present:
        path.unlink()


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    what = parser.add_subparsers(dest="what", required=True)
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("pictures", nargs="*", type=Path, help="pictures, or folders of them")
    common.add_argument("--topic", help="image topic: live, or of the bag")
    common.add_argument("--bag", type=Path, metavar="FILE", help="take the images of a bag")
    common.add_argument("--count", type=int, default=25, help="pictures from a live topic")
    common.add_argument("--every", type=float, default=1.5, help="s between pictures")
    common.add_argument("--out", type=Path, required=True, metavar="FILE")
    lens = what.add_parser("intrinsics", parents=[common], help="focal length and distortion")
    add_board_arguments(lens)
    lens.add_argument("--rational", action="store_true", help="eight coefficients, for wide lenses")
    tags = what.add_parser("mounting", parents=[common], help="tags on the straight limb")
    tags.add_argument("--tag-map", type=Path, default=CONFIG / "tags.yaml", metavar="FILE")
    tags.add_argument("--calibration", type=Path, required=True, metavar="FILE")
    options = parser.parse_args()
    try:
        _check_output(options.out)
        (intrinsics if options.what == "intrinsics" else mounting)(options)
    except (CalibrationError, CameraError, ImageError, SheetError, MapError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0
