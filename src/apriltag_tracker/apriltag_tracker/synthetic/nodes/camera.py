"""The node `synthetic_camera`: renders one image for every shape of the limb's twin."""

from __future__ import annotations

import array
import functools
import time

import cv2
import numpy as np
from sensor_msgs.msg import CameraInfo, Image

from apriltag_tracker.installed import CONFIG
from apriltag_tracker.synthetic.camera import CameraModel, Optics, SyntheticCamera
from apriltag_tracker.synthetic.nodes import ShapeListener
from apriltag_tracker.synthetic.shapes import Shape
from apriltag_tracker.tag_map import TagMap
from limb_interfaces import qos, stamps, topics
from limb_interfaces.parameters import check_overrides, declare
from limb_interfaces.runner import run_node

FRAME = "camera_optical_frame"
_INFO_PERIOD = 0.5


class SyntheticCameraNode(ShapeListener):
    """Subscribes to the twin's shape, publishes images with the shape's stamp, and camera_info."""

    def __init__(self) -> None:
        super().__init__("synthetic_camera")
        cv2.setNumThreads(1)
        read = functools.partial(declare, self)
        tag_map = read("tag_map", str(CONFIG / "tags.yaml"), "YAML file: where the tags are")
        looks = "YAML file: lens and place of the rendered camera"
        camera = read("camera_file", str(CONFIG / "synthetic_camera.yaml"), looks)
        seed = read("seed", 0, "of noise and floor", at_least=0)
        blurred = "blur of the lens, standard deviation in px"
        optics = Optics(
            noise=read("noise", Optics.noise, "noise of a pixel, grey levels", 0.0, 30.0),
            blur=read("blur", Optics.blur, blurred, 0.0, 4.0),
            exposure=read("exposure", Optics.exposure, "exposure time in s", 0.0, 0.1),
        )
        check_overrides(self)
        tags = TagMap.from_yaml(str(tag_map))
        model = CameraModel.from_yaml(str(camera))
        self._camera = SyntheticCamera(model, tags, optics, seed=int(seed))
        self._before: tuple[int, Shape] | None = None
        self._image = self._image_message()
        self._info = self._info_message()
        self._images = self.create_publisher(Image, topics.IMAGE, qos.SENSOR_DATA)
        self._infos = self.create_publisher(CameraInfo, topics.CAMERA_INFO, qos.LATCHED)
        self._last_info = 0.0
        self.listen("rendered", qos.IMAGES)
        self._publish_info()

    def _image_message(self) -> Image:
        lens = self._camera.model.intrinsics
        message = Image(height=lens.height, width=lens.width, encoding="mono8", step=lens.width)
        message.header.frame_id = FRAME
        return message

    def _info_message(self) -> CameraInfo:
        lens = self._camera.model.intrinsics
        message = CameraInfo(
            height=lens.height,
            width=lens.width,
            distortion_model="rational_polynomial",
            d=lens.distortion.tolist(),
            k=lens.matrix.ravel().tolist(),
            r=np.eye(3).ravel().tolist(),
            p=np.hstack([lens.matrix, np.zeros((3, 1))]).ravel().tolist(),
        )
        message.header.frame_id = FRAME
        return message

    def _publish_info(self) -> None:
        self._last_info = time.monotonic()
        self._infos.publish(self._info)

    def show(self, stamp: int, shape: Shape) -> None:
        """Render the shape."""
        picture = self._camera.frame(shape, self._velocity(stamp, shape)).image
        # rclpy copies an array.array in one piece; other sequences go through element by element.
        self._image.data = array.array("B", picture.tobytes())
        self._image.header.stamp = stamps.stamp_from_nanoseconds(stamp)
        self._images.publish(self._image)
        self._before = (stamp, shape)
        if time.monotonic() - self._last_info > _INFO_PERIOD:
            self._info.header.stamp = self._image.header.stamp
            self._publish_info()

    def _velocity(self, stamp: int, shape: Shape) -> Shape | None:
        """Return how fast the limb moves, from this shape and the one before."""
        if self._before is None:
            return None
        earlier, before = self._before
        elapsed = (stamp - earlier) / stamps.NANOSECONDS
        if not 0.0 < elapsed < 0.5 or len(before.heading) != len(shape.heading):
            return None
        return Shape(
            shape.arc_length,
            (shape.points - before.points) / elapsed,
            (shape.heading - before.heading) / elapsed,
        )


def main() -> int:
    """Run the node."""
    return run_node(SyntheticCameraNode)
