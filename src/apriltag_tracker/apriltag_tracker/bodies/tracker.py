"""Poses of rigid bodies in, the limb out: the tracker of bodies without ROS.

It also finds where `limb_base` is in the frame of the poses, and the plane in which the limb moves.
"""

from __future__ import annotations

import bisect
import math
from collections import deque
from dataclasses import dataclass
from functools import partial
from statistics import median_high
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from apriltag_tracker.bodies.body_map import BaseFrame, BodyMap
from apriltag_tracker.pose.following import Followed, LimbFollower, survey_errors
from apriltag_tracker.pose.shape import FollowerOptions, PlanarTag, centreline_pose

Array = NDArray[np.float64]

_MEMORY = 50
"""Frames over which fixed bodies are averaged, and after which the base follows if all of them were
moved."""
_ARM = 0.05
"""Distance of the points that stand for the axes of a body whose rotation is known [m]."""
_MISFIT = 0.003
"""RMS distance at which fixed bodies do not fit together [m]."""
_LEAST_SPREAD = 0.005
"""Points that are nearer to a line than this tell no frame [m]."""
_LEAST_MOTION = 0.003
"""RMS way across its main direction that a limb must move to show its plane [m]."""

_TOGETHER = 0.75
"""Share of the usual time between frames within which poses are of one frame."""
_INTERVAL = 50_000_000
"""Usual time from one pose of a body to its next before it is known [ns]."""
_OPEN_FRAMES = 2
"""A body that is missing is waited for until so many later frames have begun."""
_FROZEN_FRAMES = 3
"""A body whose pose has been the very same for so many frames while others moved is lost."""
_PAUSED_FRAMES = 30
"""So many frames that are the very same are no measurements."""
_FARTHEST = 1e6
"""No body is that far away [m], whatever its unit is taken for."""
_UPSIDE_DOWN = "the limb is upside down: check names and signs of fixed bodies, and rotations"
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

    Poses belong together whose stamps differ by less than the usual time between two poses of a
    body, which may be stamped one by one. A frame is complete when all bodies have come that came
    lately. Messages of one body keep their order, those of different bodies may not: a few frames
    are open at a time.

    Args:
        bodies: the body map.
    """

    def __init__(self, bodies: BodyMap) -> None:
        self._places = {name: place for place, name in enumerate(bodies.names)}
        self._frames: list[tuple[PoseFrame, set[int]]] = []
        """The last one that was told, if any, and those that are open."""
        self._told = 0
        self._expected = set(self._places.values())
        self._last: dict[str, int] = {}
        self._came: deque[int] = deque(maxlen=len(self._places))
        self._intervals = deque([_INTERVAL], maxlen=50)
        self.unknown: dict[str, int] = {}
        """Poses of bodies that are not in the map, by name."""
        self.astray: dict[str, float] = {}
        """Bodies whose stamps are of another clock than the others', by how much [s]."""

    def take(self, name: str, stamp: int, pose: tuple[float, ...]) -> list[PoseFrame]:
        """Take x, y, z and the quaternion x, y, z, w of a body; return the frames that end so."""
        place = self._places.get(name)
        if place is None:
            self.unknown[name] = self.unknown.get(name, 0) + 1
            return []
        if not self._is_of_this_clock(name, stamp):
            return []
        at = self._find(place, stamp)
        if at < self._told:
            # Of a frame that was told already: the next one waits for this body, too.
            self._expected.add(place)
            return []
        frame, given = self._frames[at]
        frame.positions[place], frame.quaternions[place] = pose[:3], pose[3:]
        given.add(place)
        if given >= self._expected:
            # The bodies that an older one lacks have come with this one.
            return self._tell(at + 1)
        if len(self._frames) - self._told > _OPEN_FRAMES:
            self._expected = set(self._frames[self._told][1])
            return self._tell(self._told + 1)
        return []

    def _is_of_this_clock(self, name: str, stamp: int) -> bool:
        """Tell whether a stamp is new and near those of the other bodies."""
        interval = stamp - self._last.get(name, stamp - _INTERVAL)
        self._last[name] = stamp
        oldest = self._frames[0][0].stamp if self._frames else stamp
        if max(interval, stamp - oldest) < -_CLOCK_SET:
            self._frames, self._told = [], 0
            self._came.clear()
        self._came.append(stamp)
        if 0 < interval < _CLOCK_SET:
            self._intervals.append(interval)
        apart = stamp - median_high(self._came)
        self.astray.pop(name, None)
        if abs(apart) > (_OPEN_FRAMES + 0.5) * median_high(self._intervals):
            self.astray[name] = 1e-9 * apart
        return name not in self.astray and interval != 0

    def _find(self, place: int, stamp: int) -> int:
        """Return which frame lacks a body that came, and is near enough; open one if none is."""
        stamps = [frame.stamp for frame, _ in self._frames]
        lacking = [at for at, (_, given) in enumerate(self._frames) if place not in given]
        at = min(lacking, key=lambda at: abs(stamps[at] - stamp), default=-1)
        if at < 0 or abs(stamps[at] - stamp) > _TOGETHER * median_high(self._intervals):
            at = bisect.bisect_left(stamps, stamp)
            if at >= self._told:
                count = len(self._places)
                frame = PoseFrame(stamp, np.full((count, 3), np.nan), np.full((count, 4), np.nan))
                self._frames.insert(at, (frame, set()))
        return at

    def _tell(self, end: int) -> list[PoseFrame]:
        ended = [frame for frame, _ in self._frames[self._told : end]]
        self._frames, self._told = self._frames[end - 1 :], 1
        return ended


def fit_frame(points: Array, places: Array) -> tuple[BaseFrame, float] | None:
    """Find the motion that brings points onto places best (Kabsch 1976).

    Args:
        points: (n, 3) m in one frame.
        places: (n, 3) m in the other.

    Returns:
        The frame and the RMS distance that is left [m]; None if the points lie on a line.
    """
    if len(points) < 3:
        return None
    middle, centre = points.mean(axis=0), places.mean(axis=0)
    root = math.sqrt(len(points))
    if np.linalg.svd(points - middle, compute_uv=False)[1] < _LEAST_SPREAD * root:
        return None
    turn, left = Rotation.align_vectors(places - centre, points - middle)
    rotation = turn.as_matrix()
    return BaseFrame(rotation, centre - rotation @ middle), left / root


class BaseFinder:
    """Keeps where `limb_base` is: from fixed bodies, averaged, or as the map says.

    Args:
        bodies: the body map.
    """

    def __init__(self, bodies: BodyMap) -> None:
        self._index = [bodies.names.index(body.name) for body in bodies.fixed]
        self._turned = np.array([body.rotation is not None for body in bodies.fixed], dtype=bool)
        axes = [np.eye(3) if body.rotation is None else body.rotation for body in bodies.fixed]
        places = np.array([body.position for body in bodies.fixed]).reshape(-1, 3)
        self._places = _arms(places, np.array(axes).reshape(-1, 3, 3))
        self._mean, self._seen = np.zeros_like(self._places), np.zeros(len(self._index))
        self._given = self.frame = bodies.frame
        self.residual = math.nan
        """RMS distance of the fixed bodies from where the map has them [m]."""
        self.problem = "" if bodies.frame else "no fixed body with a quaternion has been seen yet"

    def update(self, positions: Array, rotations: Array) -> BaseFrame | None:
        """Take one frame of all bodies and return the base to use for it, None without one.

        Args:
            positions: (n, 3) m, in the order of the map's names; NaN for what was not seen.
            rotations: (n, 3, 3) the bodies' axes, as columns.
        """
        points = _arms(positions[self._index], rotations[self._index])
        seen = np.isfinite(points[:, 0, 0])
        if self._given is not None or not seen.any():
            return self.frame
        self._seen[seen] = np.minimum(self._seen[seen] + 1, _MEMORY)
        share = 1.0 / self._seen[seen, None, None]
        self._mean[seen] += share * (points[seen] - self._mean[seen])
        # The ends of the axes count where the map says how a body is turned.
        used = (self._seen > 0)[:, None] & (self._turned[:, None] | (np.arange(4) == 0))
        found = fit_frame(self._mean[used], self._places[used])
        self.frame = None
        if found is None:
            self.problem = (
                "the fixed bodies that are seen tell no frame: three off a line are needed"
            )
        elif found[1] > _MISFIT:
            apart = f"{1e3 * found[1]:.0f} mm: check their positions, rotations, names, length_unit"
            self.problem = f"the fixed bodies do not fit together, {apart}"
        else:
            (self.frame, self.residual), self.problem = found, ""
        return self.frame


def _arms(positions: Array, rotations: Array) -> Array:
    """Return the origins of bodies and the ends of their axes, (n, 4, 3)."""
    ends = positions[:, None] + _ARM * rotations.swapaxes(1, 2)
    return np.concatenate([positions[:, None], ends], axis=1)


class PlaneWatch:
    """Finds the plane in which a limb moves, from where its bodies were so far.

    Args:
        heights: (n,) of the bodies above the centreline's plane, as the map says [m].
    """

    def __init__(self, heights: Array) -> None:
        self._heights = heights
        self._count = 0
        self._sum, self._squares = np.zeros(3), np.zeros((3, 3))

    def take(self, places: Array) -> None:
        """Take the places (n, 3) [m] of one frame; NaN for what was not seen."""
        seen = np.isfinite(places).all(axis=1)
        points = places[seen] - self._heights[seen, None] * [0.0, 0.0, 1.0]
        self._count += len(points)
        self._sum += points.sum(axis=0)
        self._squares += points.T @ points

    def values(self) -> dict[str, object]:
        """Return what to tell of it: its tilt against `limb_base`, how far bodies leave it."""
        mean = self._sum / max(self._count, 1)
        spread = self._squares / max(self._count, 1) - np.outer(mean, mean)
        squares, axes = np.linalg.eigh(spread)
        out, across = np.sqrt(np.maximum(squares[:2], 0.0))
        if across < max(_LEAST_MOTION, 3.0 * out):
            return {"plane": "the limb has not moved enough to show its plane"}
        normal = axes[:, 0] * np.copysign(1.0, axes[2, 0])
        return {
            "plane_tilt_deg": f"{math.degrees(math.acos(min(1.0, normal[2]))):.2f}",
            "plane_tilt_toward_deg": f"{math.degrees(math.atan2(normal[1], normal[0])):.0f}",
            "out_of_plane_mm_rms": f"{1e3 * out:.2f}",
        }


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
        told = (np.abs(positions) < _FARTHEST).all(axis=1) & (norms > 0.0) & (norms < np.inf)
        # No pose of a limb is exactly zero: so some systems tell that they do not see a body.
        told[self._index] &= positions[self._index].any(axis=1)
        frozen, places = self._frozen(frame), np.full((len(self._index), 3), np.nan)
        if frozen[told].all() and told[self._index].any():
            if self._same[told].min() >= _PAUSED_FRAMES:
                paused = "the poses do not change at all: is their source paused?"
                return BodyObservation(Followed(None, paused), places)
            frozen[:] = False  # a limb at rest may be told by rounded numbers
        lost = frozen | ~told
        quaternions = np.where(lost[:, None], [0.0, 0.0, 0.0, 1.0], frame.quaternions)
        rotations = Rotation.from_quat(quaternions).as_matrix()
        positions[lost], rotations[lost] = np.nan, np.nan
        base = self.base.update(positions, rotations)
        if base is None:
            return BodyObservation(Followed(None, f"no base: {self.base.problem}"), places)
        points = base.of(positions[self._index])
        axes = base.rotation @ rotations[self._index] @ self._turns.transpose(0, 2, 1)
        self.plane.take(points)
        places[:, :2] = points[:, :2]
        places[:, 2] = np.arctan2(axes[:, 1, 0], axes[:, 0, 0])
        seen = np.flatnonzero(np.isfinite(places).all(axis=1)).tolist()
        if seen and np.median(axes[seen, 2, 2]) < -0.5:
            return BodyObservation(Followed(None, _UPSIDE_DOWN), places)
        planar = []
        for k in seen:
            body = self.bodies.limb[k]
            pose = centreline_pose(places[k], body.offset)
            planar.append(PlanarTag(k, body.arc_length, pose, self._covariance))
        followed = self.follower.follow(planar, stamp, self._shared(places[seen]))
        return BodyObservation(followed, places)

    def _frozen(self, frame: PoseFrame) -> NDArray[np.bool_]:
        """Return which bodies keep their pose to the last digit, (n,)."""
        now = np.hstack([frame.positions, frame.quaternions])
        self._same = np.where((now == self._before).all(axis=1), self._same + 1, 0)
        self._before = now
        return np.asarray(self._same >= _FROZEN_FRAMES)
