"""The node `synthetic_poses`: what motion capture would tell of the limb's twin."""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import Pose, PoseArray, PoseStamped

from apriltag_tracker.bodies.body_map import BodyMap
from apriltag_tracker.bodies.forms import message_type, topics_of
from apriltag_tracker.installed import CONFIG
from apriltag_tracker.synthetic.nodes import ShapeListener
from apriltag_tracker.synthetic.poses import MocapFaults, SyntheticMocap
from apriltag_tracker.synthetic.shapes import Shape
from limb_interfaces import qos, stamps
from limb_interfaces.parameters import check_overrides, declare
from limb_interfaces.runner import run_node

_FRAME = "mocap"
_FORMS = ("pose_stamped", "pose_array")


class SyntheticPosesNode(ShapeListener):
    """Subscribes to the twin's shape and publishes the poses of the bodies on it."""

    def __init__(self) -> None:
        super().__init__("synthetic_poses")
        body_map = declare(
            self, "body_map", str(CONFIG / "bodies.yaml"), "YAML file: which body is where"
        )
        form = str(declare(self, "form", _FORMS[0], "messages in which poses go", choices=_FORMS))
        seed = declare(self, "seed", 0, "of noise and dropouts", at_least=0)
        dropout = declare(self, "dropout", 0.0, "share of frames without a body", 0.0, 1.0)
        check_overrides(self)
        bodies = BodyMap.from_yaml(str(body_map))
        faults = MocapFaults(position_noise=1e-4, direction_noise=2e-3, dropout=float(dropout))
        self._mocap = SyntheticMocap(bodies, faults, seed=int(seed))
        kind = message_type(form)
        self._outputs = {
            name: self.create_publisher(kind, place, qos.STATES)
            for name, place in topics_of(form, "", bodies.names).items()
        }
        self.listen("simulated", qos.STATES)

    def show(self, stamp: int, shape: Shape) -> None:
        """Tell the poses."""
        frame = self._mocap.frame(stamp, shape)
        poses = [_pose(*each) for each in zip(frame.positions, frame.quaternions, strict=True)]
        outputs = self._outputs
        found: dict[str, Any] = {"": PoseArray(poses=poses)}
        if "" not in outputs:
            # A body that is lost is not told of.
            found = {
                name: PoseStamped(pose=pose)
                for name, pose in zip(self._mocap.bodies.names, poses, strict=True)
                if np.isfinite(pose.position.x)
            }
        for name, each in found.items():
            each.header.stamp = stamps.stamp_from_nanoseconds(frame.stamp)
            each.header.frame_id = _FRAME
            outputs[name].publish(each)


def _pose(position: np.ndarray, quaternion: np.ndarray) -> Pose:
    pose = Pose()
    place, turn = pose.position, pose.orientation
    place.x, place.y, place.z = position.tolist()
    turn.x, turn.y, turn.z, turn.w = quaternion.tolist()
    return pose


def main() -> int:
    """Run the node."""
    return run_node(SyntheticPosesNode)
