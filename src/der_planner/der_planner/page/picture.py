"""The camera's picture for browsers, and where the limb, its tags and its path are in it."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.camera import CameraPose, Intrinsics, project
from apriltag_tracker.detection import Tag
from apriltag_tracker.pose.world import WorldPose
from apriltag_tracker.tag_map import TagMap
from der_planner.arrays import Array
from limb_interfaces.stamps import NANOSECONDS

Value = TypeVar("Value")

LOOKING = 2.0
"""Somebody counts as looking for this time [s] after the last request."""
WIDTHS = (320, 480, 640, 960)
"""Widths [px] to which a picture is made smaller for a window that shows no more."""
STRETCH = 0.85
"""A picture's width is at least this share of the width at which it is shown."""
JPEG_QUALITY = 80
VIEWS_KEPT = 60
"""The tracker's views of the last 2 s at 30 Hz are kept, so that each picture gets its own."""
LASTING = 0.5
"""An estimate, a planned limb or a tracker's view is drawn over pictures this near to it [s]."""
PATH_POINTS = 200
CURVE_POINTS = 40
SILENT = "The tracker says nothing of these pictures: neither limb nor tags are drawn."


@dataclass(frozen=True)
class Encoded:
    """A picture ready to be sent.

    Attributes:
        number: counts the pictures from 1.
        stamp: of the image [ns].
        size: width and height of the camera's image [px]; the file may be smaller.
        jpeg: the file.
    """

    number: int
    stamp: int
    size: tuple[int, int]
    jpeg: bytes


class PictureFeed:
    """Keeps the newest picture; encodes it once for all browsers that show it about as large.

    Args:
        rate: pictures a second at most.
        clock: steady [s].
    """

    def __init__(self, rate: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._interval = 1.0 / rate
        self._clock = clock
        self._lock = threading.Lock()
        self._asked = -np.inf
        self._due = -np.inf
        self._number = 0
        self._newest: tuple[int, NDArray[np.uint8]] | None = None
        self._encoded: dict[int, Encoded] = {}

    @property
    def watched(self) -> bool:
        """Whether somebody has asked for a picture lately."""
        return self._clock() - self._asked <= LOOKING

    def due(self) -> bool:
        """Tell whether the image that has just come should be put in; keeps the rate."""
        now = self._clock()
        if not self.watched or now < self._due:
            return False
        # On a grid, so that cameras of 30 Hz give 15 Hz and not 10.
        self._due = max(self._due + self._interval, now + 0.5 * self._interval)
        return True

    def put(self, stamp: int, grey: NDArray[np.uint8]) -> None:
        """Keep a picture (H, W) of an instant [ns] for whoever asks next."""
        with self._lock:
            self._number += 1
            self._newest = (stamp, grey)
            self._encoded.clear()

    def has_newer(self, after: int) -> bool:
        """Tell whether there is a picture other than number ``after``; counts as looking."""
        self._asked = self._clock()
        return self._newest is not None and self._number != after

    def take(self, shown: int = 0) -> Encoded:
        """Return the newest picture, once `has_newer` has told that there is one.

        Args:
            shown: width at which it is shown [px], which may make it smaller; 0: as it is.
        """
        with self._lock:
            assert self._newest is not None
            stamp, grey = self._newest
            height, full = grey.shape
            enough = [width for width in WIDTHS if 0 < STRETCH * shown <= width < full]
            width = min(enough, default=full)
            if width not in self._encoded:
                jpeg = _encode(grey, width)
                self._encoded[width] = Encoded(self._number, stamp, (full, height), jpeg)
            return self._encoded[width]


def _encode(grey: NDArray[np.uint8], width: int) -> bytes:
    height, full = grey.shape
    if width < full:
        size = (width, max(1, round(height * width / full)))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


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
        self._views: deque[tuple[int, tuple[Array, Array]]] = deque(maxlen=VIEWS_KEPT)
        self._corners: deque[tuple[int, list[list[float]]]] = deque(maxlen=VIEWS_KEPT)
        self._path: Array = np.empty((0, 2))
        self._shapes: dict[str, tuple[float, Array]] = {}

    def put_camera(self, intrinsics: Intrinsics) -> None:
        """Take the camera's calibration; the pose is found anew if it changed."""
        with self._lock:
            old = self._intrinsics
            if old is None or not all(map(np.array_equal, astuple(old), astuple(intrinsics))):
                self._intrinsics = intrinsics
                self._world = WorldPose(self._tags, intrinsics)

    def put_tags(self, stamp: int, tags: Sequence[Tag]) -> None:
        """Take the tags of one image [ns]; fixed ones tell where the camera is."""
        with self._lock:
            corners = [[round(float(v), 1) for v in tag.corners.ravel()] for tag in tags]
            self._corners.append((stamp, corners))
            if self._world is not None:
                self._world.update(tags)

    def put_limb(self, stamp: int, curve: Array, tip: Array) -> None:
        """Take what the tracker saw in one image; both are empty where it does not vouch for it.

        Args:
            stamp: of the image [ns].
            curve: (N, 2) centreline [m], base to tip.
            tip: (1, 2) [m].
        """
        with self._lock:
            self._views.append((stamp, (curve, tip)))

    def put_path(self, tip: Array) -> None:
        """Take the reference path (K, 2) [m] of the tip."""
        self._path = tip[:: max(1, len(tip) // PATH_POINTS)]

    def put_shape(self, kind: str, curve: Array) -> None:
        """Take a centreline (N, 2) [m] that is ``planned`` or an ``estimate`` of feedback."""
        with self._lock:
            self._shapes[kind] = self._clock(), curve

    def camera_problem(self) -> tuple[bool, str]:
        """Tell whether a calibration has come, and why the camera's pose is not known, if so."""
        with self._lock:
            if self._world is None:
                return False, "no calibration of the camera yet"
            return True, self._world.problem

    def pixels_of(self, points: Array) -> list[list[float]]:
        """Return the pixels of points (P, 2) [m] of the limb's plane; none without a pose."""
        placed = self._pose()
        # Another program may say that something is nowhere; a picture cannot show it there.
        points = points[np.isfinite(points).all(axis=1)]
        if placed is None or not len(points):
            return []
        raised = np.column_stack([points, np.full(len(points), self._height)])
        pixels: list[list[float]] = np.round(project(*placed, raised), 1).tolist()
        return pixels

    def on_plane(self, pixels: Array) -> Array | None:
        """Return the points (P, 2) [m] of the plane at pixels (P, 2); None without a pose."""
        placed = self._pose()
        if placed is None:
            return None
        intrinsics, pose = placed
        return pose.onto_plane(intrinsics.rays(pixels), self._height)

    def _pose(self) -> tuple[Intrinsics, CameraPose] | None:
        with self._lock:
            pose = self._world.pose if self._world is not None else None
            return None if self._intrinsics is None or pose is None else (self._intrinsics, pose)

    def at(self, stamp: int, reference: tuple[float, float] | None) -> dict[str, Any]:
        """Return what belongs over the picture of an instant, in pixels.

        Args:
            stamp: of the picture [ns].
            reference: where the tip should be then [m].

        Returns:
            `tags`: eight numbers each; `curve`, `path`, `planned`, `estimate`: lists of points;
            `tip` and `reference`: points or None; `problem`: why nothing can be placed, else empty.
        """
        with self._lock:
            view, corners = _nearest(stamp, self._views), _nearest(stamp, self._corners)
            silent = bool(self._views) and view is None
            now, came = self._clock(), dict(self._shapes)
        nothing = np.empty((0, 2))
        curve, tip = view or (nothing, nothing)
        wanted = nothing if reference is None else np.array([reference])
        shapes = {kind: shape for kind, (at, shape) in came.items() if now - at <= LASTING}
        return {
            "tags": corners or [],
            "curve": self.pixels_of(curve[:: max(1, len(curve) // CURVE_POINTS)]),
            "path": self.pixels_of(self._path),
            "planned": self.pixels_of(shapes.get("planned", nothing)),
            "estimate": self.pixels_of(shapes.get("estimate", nothing)),
            "tip": next(iter(self.pixels_of(tip)), None),
            "reference": next(iter(self.pixels_of(wanted)), None),
            "problem": SILENT if silent else self.camera_problem()[1],
        }


def _nearest(stamp: int, entries: Sequence[tuple[int, Value]]) -> Value | None:
    """Return what came for this stamp [ns], or the newest unless it is too far from it."""
    for known, value in reversed(entries):
        if known == stamp:
            return value
    if entries and abs(entries[-1][0] - stamp) <= LASTING * NANOSECONDS:
        return entries[-1][1]
    return None
