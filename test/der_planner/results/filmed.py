"""A synthetic run with a camera: pictures, tags, calibration and the planner's limb, as a bag."""

from pathlib import Path

import cv2
import numpy as np
from runs import BagOfRun

CAMERA = np.array([[300.0, 0.0, 158.0], [0.0, 305.0, 121.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.12, 0.03, 0.001, -0.0005, 0.0])
ROTATION = np.array([0.05, 3.08, 0.1])
POSITION = np.array([0.1, 0.02, 0.55])
HEIGHT = 0.03


def pixels(points: np.ndarray) -> np.ndarray:
    """Project points (N, 2) [m] of the plane of the tags with OpenCV's camera model."""
    lifted = np.column_stack([points, np.full(len(points), HEIGHT)])
    return cv2.projectPoints(lifted, ROTATION, POSITION, CAMERA, DISTORTION)[0][:, 0, :]


TAGS = "der_msgs/msg/TagDetectionArray"


class FilmedRun(BagOfRun):
    """A run with camera and tags."""

    def __init__(self, folder: Path, **options) -> None:
        super().__init__(folder, types=(TAGS,), **options)

    def frame(self, seconds: float, shade: int) -> None:
        data = np.full(240 * 320, shade, dtype=np.uint8)
        about = {"height": 240, "width": 320, "encoding": "mono8", "step": 320}
        self.write("/limb/camera/image_raw", "sensor_msgs/msg/Image", seconds, data=data, **about)

    def calibration(self, matrix: np.ndarray = CAMERA) -> None:
        about = {"height": 240, "width": 320, "distortion_model": "plumb_bob"}
        name = "sensor_msgs/msg/CameraInfo"
        self.write("/limb/camera/camera_info", name, 0.0, d=DISTORTION, k=matrix.ravel(), **about)

    def tags(self, seconds: float, centres: np.ndarray) -> None:
        square = 0.01 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        detections = [
            self.make(
                "der_msgs/msg/TagDetection",
                id=i,
                corners=pixels(centre + square).ravel(),
                on_limb=True,
                pose_valid=True,
                pose=self.make("geometry_msgs/msg/Pose2D", x=centre[0], y=centre[1]),
            )
            for i, centre in enumerate(centres)
        ]
        self.write("/limb/tags", TAGS, seconds, detections=detections)
