"""A synthetic run with a camera: pictures, tags, calibration and the planner's limb, as a bag."""

from pathlib import Path

import cv2
import numpy as np
from bags import spec
from rosbags.typesys import get_types_from_msg
from runs import BagOfRun

from der_planner.bags.topics import find_definition

CAMERA = np.array([[300.0, 0.0, 158.0], [0.0, 305.0, 121.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.12, 0.03, 0.001, -0.0005, 0.0])
ROTATION = np.array([0.05, 3.08, 0.1])
POSITION = np.array([0.1, 0.02, 0.55])
HEIGHT = 0.03


def pixels(points: np.ndarray) -> np.ndarray:
    """Project points (N, 2) [m] of the plane of the tags with OpenCV's camera model."""
    lifted = np.column_stack([points, np.full(len(points), HEIGHT)])
    return cv2.projectPoints(lifted, ROTATION, POSITION, CAMERA, DISTORTION)[0][:, 0, :]


class FilmedRun(BagOfRun):
    """A run with camera, tags and the planner's limb."""

    def __init__(self, folder: Path, **options) -> None:
        super().__init__(folder, **options)
        for name in (
            "der_msgs/msg/TagDetectionArray",
            "visualization_msgs/msg/MarkerArray",
            "sensor_msgs/msg/CameraInfo",
        ):
            found = get_types_from_msg(find_definition(name).text, name)
            self.types.register({k: v for k, v in found.items() if k not in self.types.types})
        self.kinds = self.types.types

    def put(self, topic: str, name: str, seconds: float, message) -> None:
        self.bag.add_topic(spec(topic, name))
        data = bytes(self.types.serialize_cdr(message, name))
        self.bag.write(topic, self.stamp(seconds + 0.03), self.stamp(seconds), data)

    def frame(self, seconds: float, shade: int) -> None:
        data = np.full((240, 320), shade, dtype=np.uint8)
        self.put(
            "/limb/camera/image_raw",
            "sensor_msgs/msg/Image",
            seconds,
            self.kinds["sensor_msgs/msg/Image"](
                header=self.header(seconds),
                height=240,
                width=320,
                encoding="mono8",
                is_bigendian=0,
                step=320,
                data=data.ravel(),
            ),
        )

    def calibration(self) -> None:
        region = self.kinds["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        self.put(
            "/limb/camera/camera_info",
            "sensor_msgs/msg/CameraInfo",
            0.0,
            self.kinds["sensor_msgs/msg/CameraInfo"](
                header=self.header(0.0),
                height=240,
                width=320,
                distortion_model="plumb_bob",
                d=DISTORTION,
                k=CAMERA.ravel(),
                r=np.eye(3).ravel(),
                p=np.zeros(12),
                binning_x=0,
                binning_y=0,
                roi=region,
            ),
        )

    def tags(self, seconds: float, centres: np.ndarray) -> None:
        square = 0.01 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        detections = [
            self.kinds["der_msgs/msg/TagDetection"](
                id=i,
                corners=pixels(centre + square).ravel(),
                on_limb=True,
                pose_valid=True,
                pose=self.kinds["geometry_msgs/msg/Pose2D"](x=centre[0], y=centre[1], theta=0.0),
                pixel_size=20.0,
                line_residual=0.0,
            )
            for i, centre in enumerate(centres)
        ]
        name = "der_msgs/msg/TagDetectionArray"
        message = self.kinds[name](header=self.header(seconds), detections=detections)
        self.put("/limb/tags", name, seconds, message)
