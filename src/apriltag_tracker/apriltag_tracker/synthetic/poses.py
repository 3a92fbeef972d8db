"""What motion capture would tell of a simulated limb, with what goes wrong in real systems."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from apriltag_tracker.bodies.body_map import BodyMap
from apriltag_tracker.bodies.tracker import PoseFrame
from apriltag_tracker.synthetic.shapes import Shape

TURN = 0.3
"""Of `limb_base` about the axis z, which is up, in the frame of the poses [rad]."""


@dataclass(frozen=True)
class MocapFaults:
    """What the poses have of a real system; nothing of it by default.

    Attributes:
        position_noise: standard deviation of a coordinate [m].
        direction_noise: standard deviation of a turn about each axis [rad].
        dropout: share of frames in which a body is lost, each for itself.
    """

    position_noise: float = 0.0
    direction_noise: float = 0.0
    dropout: float = 0.0


class SyntheticMocap:
    """Tells the poses of the bodies on and around a limb.

    Args:
        bodies: the body map; poses come in its unit.
        faults: what is wrong with them.
        seed: of noise and dropouts.
    """

    def __init__(self, bodies: BodyMap, faults: MocapFaults | None = None, seed: int = 0) -> None:
        self.bodies, self.faults = bodies, faults or MocapFaults()
        self._random = np.random.default_rng(seed)
        self.rotation: NDArray[np.float64] = Rotation.from_euler("z", TURN).as_matrix()
        """(3, 3) the axes of `limb_base` in the frame of the poses, as columns."""
        self.origin = np.array([0.4, -0.2, 0.9])
        """Where the clamp is in the frame of the poses [m]."""

    def frame(self, stamp: int, shape: Shape) -> PoseFrame:
        """Return the poses of all bodies at an instant [ns] in which the limb has a shape."""
        faults, bodies = self.faults, self.bodies
        count = len(bodies.names)
        positions, axes = np.empty((count, 3)), np.empty((count, 3, 3))
        for fixed in bodies.fixed:
            k = bodies.names.index(fixed.name)
            positions[k] = fixed.position
            axes[k] = np.eye(3) if fixed.rotation is None else fixed.rotation
        for body in bodies.limb:
            k = bodies.names.index(body.name)
            x, y, heading = shape.at(body.arc_length)
            along, across, turn = body.offset
            about = Rotation.from_euler("z", heading)
            positions[k] = np.array([x, y, body.height]) + about.apply([along, across, 0.0])
            axes[k] = (about * Rotation.from_euler("z", turn)).as_matrix() @ body.rotation
        positions = positions @ self.rotation.T + self.origin
        positions += faults.position_noise * self._random.standard_normal((count, 3))
        noise = faults.direction_noise * self._random.standard_normal((count, 3))
        turns = Rotation.from_matrix(self.rotation @ axes) * Rotation.from_rotvec(noise)
        quaternions = np.asarray(turns.as_quat(), dtype=np.float64)
        positions[self._random.random(count) < faults.dropout] = np.nan
        return PoseFrame(stamp, positions / bodies.unit, quaternions)
