"""Poses of rigid bodies in, the limb out: the tracker of bodies without ROS."""

from __future__ import annotations

import bisect
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from apriltag_tracker.bodies.base import BaseFinder, PlaneWatch
from apriltag_tracker.bodies.body_map import BodyMap
from apriltag_tracker.pose.following import (
    Followed,
    FollowerOptions,
    LimbFollower,
    survey_errors,
)
from apriltag_tracker.pose.shape import PlanarTag, centreline_pose

Array = NDArray[np.float64]

_SAME_INSTANT = 1_000_000
"""Stamps that are nearer than this belong to one frame [ns]."""
_OPEN_FRAMES = 2
"""A body that is missing is waited for until so many later frames have begun."""
_FROZEN_FRAMES = 3
"""A body whose pose has been the very same for so many frames while others moved is lost."""
_CLOCK_SET = 1_000_000_000
"""Stamps that go back by more than this are of a clock that was set [ns]."""


class PoseFrame(NamedTuple):
    """The bodies at one instant.

    Attributes:
        stamp: [ns].
        positions: (n, 3) in the map's unit and the order of its names; NaN for what is missing.
        quaternions: (n, 4) x, y, z, w.
    """

    stamp: int
    positions: Array
    quaternions: Array


class FrameAssembler:
    """Puts poses that come one body at a time together to frames.

    A frame is complete when all bodies have come that came lately. Messages of one body keep their
    order, those of different bodies may not: a few frames are open at a time.

    Args:
        bodies: the body map.
    """

    def __init__(self, bodies: BodyMap) -> None:
        self._places = {name: place for place, name in enumerate(bodies.names)}
        self._open: list[tuple[PoseFrame, set[int]]] = []
        self._closed: int | None = None
        self._expected = set(self._places.values())
        self.unknown: dict[str, int] = {}
        """Poses of bodies that are not in the map, by name."""

    def take(self, name: str, stamp: int, pose: tuple[float, ...]) -> list[PoseFrame]:
        """Take x, y, z and the quaternion x, y, z, w of a body; return the frames that end so."""
        place = self._places.get(name)
        if place is None:
            self.unknown[name] = self.unknown.get(name, 0) + 1
            return []
        if self._closed is not None and stamp <= self._closed + _SAME_INSTANT:
            if stamp > self._closed - _CLOCK_SET:
                # Of a frame that was told already: the next one waits for this body, too.
                self._expected.add(place)
                return []
            self._open, self._closed = [], None
        at = bisect.bisect(self._open, stamp - _SAME_INSTANT - 1, key=lambda each: each[0].stamp)
        if at == len(self._open) or self._open[at][0].stamp > stamp + _SAME_INSTANT:
            count = len(self._places)
            frame = PoseFrame(stamp, np.full((count, 3), np.nan), np.full((count, 4), np.nan))
            self._open.insert(at, (frame, set()))
        frame, given = self._open[at]
        frame.positions[place], frame.quaternions[place] = pose[:3], pose[3:]
        given.add(place)
        if given >= self._expected:
            # The bodies that an older one lacks have come with this one.
            return self._close(at + 1)
        if len(self._open) > _OPEN_FRAMES:
            self._expected = set(self._open[0][1])
            return self._close(1)
        return []

    def _close(self, count: int) -> list[PoseFrame]:
        frames = [frame for frame, _ in self._open[:count]]
        self._open, self._closed = self._open[count:], frames[-1].stamp
        return frames


@dataclass(frozen=True)
class BodyNoise:
    """Standard deviations of a pose from frame to frame: position [m] and direction [rad]."""

    position: float = 1e-4
    direction: float = 3e-3


@dataclass(frozen=True)
class BodyObservation:
    """What one frame says about the limb.

    Attributes:
        followed: the limb.
        places: (n, 3) x, y [m] and heading [rad] of the limb's bodies in `limb_base`, their own
            axes turned as the map says; NaN for what is missing.
    """

    followed: Followed
    places: Array


class BodyTracker:
    """Follows a limb through frames of poses.

    Args:
        bodies: the body map.
        options: how the limb is followed; of the uncertainty all but the height counts.
        noise: of the poses.
    """

    def __init__(
        self,
        bodies: BodyMap,
        options: FollowerOptions | None = None,
        noise: BodyNoise | None = None,
    ) -> None:
        self.bodies = bodies
        self._options = options or FollowerOptions()
        noise = noise or BodyNoise()
        self._covariance = np.diag([noise.position, noise.position, noise.direction]) ** 2
        self.base = BaseFinder(bodies)
        fixed = np.array([body.position[:2] for body in bodies.fixed] or [np.zeros(2)])
        survey, least = self._options.uncertainty.survey, 0.01 if len(fixed) > 1 else bodies.length
        self._shared = partial(survey_errors, fixed=fixed, survey=survey, least_spread=least)
        self.plane = PlaneWatch(np.array([body.height for body in bodies.limb]))
        self.follower = LimbFollower(bodies, self._options, "body", "in the poses")
        self._index = [bodies.names.index(body.name) for body in bodies.limb]
        self._turns = np.array([body.rotation for body in bodies.limb])
        self._before = np.full((len(bodies.names), 7), np.nan)
        self._same = np.zeros(len(bodies.names), dtype=np.int64)

    def observe(self, frame: PoseFrame) -> BodyObservation:
        """Find the limb in one frame."""
        stamp = frame.stamp * 1e-9
        positions = self.bodies.unit * frame.positions
        norms = np.linalg.norm(frame.quaternions, axis=1)
        lost = ~(np.isfinite(positions).all(axis=1) & (np.abs(norms - 1.0) < 0.1))
        lost |= self._frozen(frame)
        quaternions = np.where(lost[:, None], [0.0, 0.0, 0.0, 1.0], frame.quaternions)
        rotations = Rotation.from_quat(quaternions).as_matrix()
        positions[lost], rotations[lost] = np.nan, np.nan
        places = np.full((len(self._index), 3), np.nan)
        base = self.base.update(positions, rotations)
        if base is None:
            return BodyObservation(Followed(None, f"no base: {self.base.problem}"), places)
        points = base.of(positions[self._index])
        axes = base.rotation @ rotations[self._index] @ self._turns.transpose(0, 2, 1)
        self.plane.take(points)
        places[:, :2] = points[:, :2]
        places[:, 2] = np.arctan2(axes[:, 1, 0], axes[:, 0, 0])
        seen = np.flatnonzero(np.isfinite(places).all(axis=1)).tolist()
        planar = []
        for k in seen:
            body = self.bodies.limb[k]
            pose = centreline_pose(places[k], body.offset)
            planar.append(PlanarTag(k, body.arc_length, pose, self._covariance))
        followed = self.follower.follow(planar, stamp, self._shared(places[seen]))
        return BodyObservation(followed, places)

    def _frozen(self, frame: PoseFrame) -> NDArray[np.bool_]:
        """Return which bodies keep their pose to the last digit while others move, (n,)."""
        now = np.hstack([frame.positions, frame.quaternions])
        self._same = np.where((now == self._before).all(axis=1), self._same + 1, 0)
        self._before = now
        frozen = self._same >= _FROZEN_FRAMES
        return frozen if not frozen[np.isfinite(now).all(axis=1)].all() else np.zeros_like(frozen)
