"""Where the limb, its tags and its path are in the camera's picture."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.camera import CameraPose, Intrinsics, project
from apriltag_tracker.detection import Tag
from apriltag_tracker.pose.world import WorldPose
from apriltag_tracker.tag_map import TagMap
from der_planner.page.situation import NANOSECONDS, LimbView

KEPT = 60
"""Views of the limb kept, so that each picture gets its own: 2 s at 30 Hz."""
PATH_POINTS = 200
LASTING = 0.5
"""[s] that an estimate or a planned limb is shown after it came, and how far the tracker's view may
be from the picture that it is drawn over."""
CURVE_POINTS = 40
SILENT = "The tracker says nothing of these pictures: neither limb nor tags are drawn."

Value = TypeVar("Value")


class Overlay:
    """Turns metres in `limb_base` into pixels, with the camera's pose from the fixed tags.

    Args:
        tags: the tag map that the tracker uses.
        clock: steady [s].
    """

    def __init__(self, tags: TagMap, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._tags = tags
        self._height = max(tag.height for tag in tags.limb)
        self._lock = threading.Lock()
        self._intrinsics: Intrinsics | None = None
        self._world: WorldPose | None = None
        self._views: deque[LimbView] = deque(maxlen=KEPT)
        self._corners: deque[tuple[int, list[list[float]]]] = deque(maxlen=KEPT)
        self._path: NDArray[np.float64] = np.empty((0, 2))
        self._limb: tuple[float, NDArray[np.float64]] = (-np.inf, np.empty((0, 2)))
        self._estimate: tuple[float, NDArray[np.float64]] = (-np.inf, np.empty((0, 2)))

    def put_camera(self, intrinsics: Intrinsics) -> None:
        """Take the camera's calibration; the pose is found anew if it changed."""
        with self._lock:
            old = self._intrinsics
            same = old is not None and np.array_equal(old.matrix, intrinsics.matrix)
            if not same:
                self._intrinsics = intrinsics
                self._world = WorldPose(self._tags, intrinsics)

    def put_tags(self, stamp: int, tags: Sequence[Tag]) -> None:
        """Take the tags of one image [ns]; fixed ones tell where the camera is."""
        with self._lock:
            corners = [[round(float(v), 1) for v in tag.corners.ravel()] for tag in tags]
            self._corners.append((stamp, corners))
            if self._world is not None:
                self._world.update(tags)

    def put_limb(self, view: LimbView) -> None:
        """Take the tracker's view of one image."""
        with self._lock:
            self._views.append(view)

    def put_path(self, tip: NDArray[np.float64]) -> None:
        """Take the reference path of the tip, (K, 2) m."""
        step = max(1, len(tip) // PATH_POINTS)
        with self._lock:
            self._path = tip[::step]

    def put_planned(self, curve: NDArray[np.float64]) -> None:
        """Take the centreline (N, 2) m of the planned limb; shown for `LASTING` seconds."""
        with self._lock:
            self._limb = (self._clock(), curve)

    def put_estimate(self, curve: NDArray[np.float64]) -> None:
        """Take the centreline (N, 2) m that feedback estimates; shown for `LASTING` seconds."""
        with self._lock:
            self._estimate = (self._clock(), curve)

    def camera(self) -> tuple[bool, str]:
        """Tell whether a calibration has come, and why the camera's pose is not known, if so."""
        with self._lock:
            if self._world is None:
                return False, "no calibration of the camera yet"
            return True, self._world.problem

    def pixels_of(self, points: NDArray[np.float64]) -> list[list[float]]:
        """Return the pixels of points (P, 2) [m] of the limb's plane; none without a pose."""
        placer = self._placer()
        return [] if placer is None else placer(points)

    def on_plane(self, pixels: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the points (P, 2) [m] of the plane at pixels (P, 2); None without a pose."""
        placer = self._placer()
        return None if placer is None else placer.back(pixels)

    def _placer(self) -> _Placer | None:
        with self._lock:
            pose = self._world.pose if self._world is not None else None
            if self._intrinsics is None or pose is None:
                return None
            return _Placer(self._intrinsics, pose, self._height)

    def at(self, stamp: int, reference: tuple[float, float] | None) -> dict[str, Any]:
        """Return what belongs over the picture of an instant, in pixels.

        Args:
            stamp: of the picture [ns].
            reference: where the tip should be then [m].

        Returns:
            `tags`: eight numbers each; `curve`, `path`, `planned`, `estimate`: lists of points;
            `tip` and `reference`: points or None; `matched`: whether the view is of this very
            picture; `problem`: why nothing can be placed, else empty.
        """
        with self._lock:
            view = _of(stamp, [view.stamp for view in self._views], self._views)
            corners = _of(stamp, [s for s, _ in self._corners], [c for _, c in self._corners])
            pose = self._world.pose if self._world is not None else None
            intrinsics, path = self._intrinsics, self._path
            (shown, planned), (heard, estimate) = self._limb, self._estimate
            silent = bool(self._views) and view is None
            problem = "no calibration of the camera yet"
            if self._world is not None:
                problem = self._world.problem
        answer: dict[str, Any] = {
            "tags": corners or [],
            "matched": view is not None and view.stamp == stamp,
            "problem": SILENT if silent else problem,
            "curve": [],
            "path": [],
            "planned": [],
            "estimate": [],
            "tip": None,
            "reference": None,
        }
        if intrinsics is None or pose is None:
            return answer
        place = _Placer(intrinsics, pose, self._height)
        if view is not None and view.valid:
            curve = np.array(view.curve).reshape(-1, 2)
            answer["curve"] = place(curve[:: max(1, len(curve) // CURVE_POINTS)])
            answer["tip"] = place.point(view.tip)
        answer["path"], now = place(path), self._clock()
        if now - shown <= LASTING:
            answer["planned"] = place(planned)
        if now - heard <= LASTING:
            answer["estimate"] = place(estimate)
        if reference is not None:
            answer["reference"] = place.point(reference)
        return answer


class _Placer:
    def __init__(self, intrinsics: Intrinsics, pose: CameraPose, height: float) -> None:
        self._intrinsics, self._pose, self._height = intrinsics, pose, height

    def __call__(self, points: NDArray[np.float64]) -> list[list[float]]:
        # Another program may say that something is nowhere; a picture cannot show it there.
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            return []
        raised = np.column_stack([points, np.full(len(points), self._height)])
        pixels: list[list[float]] = np.round(
            project(self._intrinsics, self._pose, raised), 1
        ).tolist()
        return pixels

    def point(self, point: tuple[float, float]) -> list[float] | None:
        return next(iter(self(np.array([point]))), None)

    def back(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._pose.onto_plane(self._intrinsics.rays(pixels), self._height)


def _of(stamp: int, stamps: Sequence[int], values: Sequence[Value]) -> Value | None:
    """Return the value of this picture's stamp [ns], or the newest unless it is too far from it."""
    for known, value in zip(reversed(stamps), reversed(values), strict=True):
        if known == stamp:
            return value
    if stamps and abs(stamps[-1] - stamp) <= LASTING * NANOSECONDS:
        return values[-1]
    return None
