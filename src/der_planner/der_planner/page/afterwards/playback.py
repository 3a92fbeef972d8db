"""A recorded bag as the page shows it: curves for a slider, and the picture of each instant.

`describe` and `frame` run in a process of their own (`page.worker`), which keeps the bags open.
"""

from __future__ import annotations

import json
import math
import struct
from collections import OrderedDict
from datetime import datetime
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.camera.images import ImageError, to_grey
from der_planner.page.overlay import CURVE_POINTS, PATH_POINTS
from der_planner.page.situation import CENTIMETRES, MODES, PASCAL_PER_KILOPASCAL
from der_planner.runs.record import NANOSECONDS
from der_planner.runs.recording.reader import BagError
from der_planner.runs.scenes import Scenes

KEPT = 2
"""Bags that stay open, one for each of two windows."""
MOST_SAMPLES = 20_000
"""Of a curve; a longer one is thinned."""
LASTING = NANOSECONDS // 2
"""[ns] that a message counts as the present one."""
PLAN_LASTING = 24 * 3600 * NANOSECONDS
TRAIL = 10 * NANOSECONDS
"""[ns] of the tip's past that is drawn."""
TRAIL_POINTS = 150
JPEG_QUALITY = 80
PLAIN_SIZE = (1280, 720)
"""[px] of the plain background of a bag without pictures."""
MARGIN = 0.15
"""Share of a plain background that stays free on each side."""

Place = Any
"""From points (P, 2) [m] to pixels: lists of pairs."""


class Playback:
    """One open bag, its instants in seconds since its first message.

    Args:
        path: bag folder or file.

    Raises:
        BagError: it cannot be read, or holds nothing of a limb.
    """

    def __init__(self, path: str) -> None:
        self.scenes = Scenes(path)
        self._tracks = self.scenes.tracks
        self._place: Place = _nowhere
        if self.scenes.projection is not None:
            self._place = _Projected(self.scenes.projection)
        elif not self.scenes.has_pictures:
            self._place = _Plain(self._extent())

    @property
    def duration(self) -> float:
        """[s] from the first to the last message."""
        return (self.scenes.end - self.scenes.start) / NANOSECONDS

    def describe(self) -> dict[str, Any]:
        """Return what the bag is, what it lacks, and its curves in kPa, degrees and cm."""
        scenes = self.scenes
        began = datetime.fromtimestamp(scenes.start / NANOSECONDS).astimezone()
        return {
            "bag": str(scenes.path.resolve()),
            "recorded": began.strftime("%Y-%m-%d %H:%M:%S"),
            "duration": round(self.duration, 3),
            "about": self._about(),
            "notes": self._notes(),
            "driver": self._driver_curves(),
            "limb": self._limb_curves(),
            "pictures": scenes.has_pictures,
        }

    def frame(self, at: float) -> bytes:
        """Return picture and overlay of an instant [s] as the page's server sends live ones.

        Four bytes of length, the overlay as JSON, the picture as JPEG (none where none was
        recorded).

        Raises:
            BagError: the bag is damaged there.
        """
        when = self.scenes.start + round(min(max(at, 0.0), self.duration) * NANOSECONDS)
        picture = self.scenes.picture(when)
        placed = self.scenes.projection is not None and self.scenes.size is not None
        size = self.scenes.size if placed else PLAIN_SIZE
        jpeg, note = b"", ""
        if picture is not None:
            # What belongs to the picture, not to the slider's instant beside it.
            when = picture.stamp
            message = picture.message
            try:
                grey = to_grey(
                    message.data, message.height, message.width, message.step, message.encoding,
                    bool(message.is_bigendian),
                )  # fmt: skip
                size = (grey.shape[1], grey.shape[0])
                encoded = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
                jpeg = encoded.tobytes()
            except ImageError as error:
                note = str(error)
        elif self.scenes.has_pictures:
            note = "No picture was recorded near this instant."
        head = {"size": size, "at": round(self._seconds(when), 3), "problem": note}
        head |= self._overlay(when)
        text = json.dumps(head, separators=(",", ":"), allow_nan=False).encode()
        return struct.pack(">I", len(text)) + text + jpeg

    # Of an instant --------------------------------------------------------------------------

    def _overlay(self, when: int) -> dict[str, Any]:
        tracks, place = self._tracks, self._place
        view, plan = tracks.limb.at(when, LASTING), tracks.plan.at(when, PLAN_LASTING)
        view = view if view is not None and view.valid else None
        on_plain = isinstance(place, _Plain)
        tags = None if on_plain else tracks.tags.at(when, LASTING)
        planned, estimate = tracks.planned.at(when, LASTING), tracks.estimate.at(when, LASTING)
        reference = tracks.reference.at(when, LASTING)
        seen = [each.tip for each in tracks.limb.between(when - TRAIL, when) if each.valid]
        nothing = np.empty((0, 2))
        return {
            "tags": [] if tags is None else np.round(tags.astype(float), 1).tolist(),
            "curve": place(_line(nothing if view is None else view.curve, CURVE_POINTS)),
            "tip": None if view is None else _first(place(_line([view.tip]))),
            "path": place(_line(nothing if plan is None else plan.tip, PATH_POINTS)),
            "planned": place(_line(nothing if planned is None else planned)),
            "estimate": place(_line(nothing if estimate is None else estimate, CURVE_POINTS)),
            "reference": None if reference is None else _first(place(_line([reference]))),
            "trail": place(_line(seen, TRAIL_POINTS)),
        }

    def _seconds(self, stamp: int) -> float:
        return (stamp - self.scenes.start) / NANOSECONDS

    def _extent(self) -> NDArray[np.float64]:
        """Return the corners (2, 2) [m] of everything that is drawn."""
        tracks = self._tracks
        points = [np.array([[0.0, 0.0]])]
        points += [plan.tip for plan in tracks.plan.values]
        points += [view.curve for view in tracks.limb.values[::10] if view.valid]
        points += [np.array([view.tip]) for view in tracks.limb.values if view.valid]
        points += tracks.planned.values[::10]
        everything = np.concatenate([_line(each) for each in points])
        return np.array([everything.min(axis=0), everything.max(axis=0)])

    # Of the whole bag -----------------------------------------------------------------------

    def _about(self) -> str:
        plans = self._tracks.plan.values
        kinds = dict.fromkeys(f"{plan.motion} {plan.model} {plan.method}".strip() for plan in plans)
        note = str(self.scenes.run.get("note", "")).strip()
        parts = [", ".join(kinds) or "no motion was planned", *([f"note: {note}"] if note else [])]
        return "; ".join(parts)

    def _notes(self) -> list[str]:
        """Return what the bag lacks, a sentence each."""
        scenes, tracks, notes = self.scenes, self._tracks, []
        if scenes.unfinished:
            notes.append(
                "The recorder was ended before it could close this bag; everything up to the cut "
                f"is shown. scripts/recover_bag.py {scenes.path} repairs it."
            )
        if not scenes.has_pictures:
            notes.append(
                "This bag holds no camera pictures (the recorder takes them with "
                "record_images:=true): what was measured is drawn on a plain background."
            )
        elif scenes.projection is None:
            notes.append(
                "This bag lacks the camera's calibration or tags on the limb, so nothing can be "
                "placed in its pictures."
            )
        if not tracks.limb.stamps:
            notes.append("This bag holds no states of the limb: did the tracker run?")
        if not tracks.driver.stamps:
            notes.append("This bag holds no pressures: did the driver run?")
        if scenes.others:
            others = ", ".join(scenes.others)
            notes.append(f"This is the limb {scenes.namespace}; the bag holds {others}, too.")
        return notes

    def _driver_curves(self) -> dict[str, Any]:
        track = self._tracks.driver
        chosen = range(0, len(track.stamps), _step(len(track.stamps)))
        values = [track.values[k] for k in chosen]
        modes: list[tuple[float, str, str]] = []
        for stamp, value in zip(track.stamps, track.values, strict=True):
            name = MODES[value.mode] if 0 <= value.mode < len(MODES) else f"mode {value.mode}"
            reasons = "; ".join(value.faults)
            if not modes or modes[-1][1:] != (name, reasons):
                modes.append((round(self._seconds(stamp), 3), name, reasons))
        return {
            "at": [round(self._seconds(track.stamps[k]), 3) for k in chosen],
            "measured": [_numbers(each.measured, 1 / PASCAL_PER_KILOPASCAL, 3) for each in values],
            "commanded": [
                _numbers(each.commanded, 1 / PASCAL_PER_KILOPASCAL, 3) for each in values
            ],
            "modes": modes,
        }

    def _limb_curves(self) -> dict[str, Any]:
        track, references = self._tracks.limb, self._tracks.reference
        chosen = range(0, len(track.stamps), _step(len(track.stamps)))
        bend: list[list[float | None] | None] = []
        error: list[list[float | None] | None] = []
        when = np.array(references.stamps, dtype=np.int64)
        where = np.array(references.values).reshape(-1, 2)
        for k in chosen:
            stamp, view = track.stamps[k], track.values[k]
            bend.append(_numbers(view.bend, math.degrees(1.0), 2) if view.valid else None)
            wanted = _between(when, where, stamp) if view.valid else None
            away = None if wanted is None else math.dist(wanted, view.tip) * CENTIMETRES
            error.append(None if away is None else [round(away, 3)])
        at = [round(self._seconds(track.stamps[k]), 3) for k in chosen]
        return {"at": at, "bend": bend, "error": error}


class _Projected:
    def __init__(self, projection: Any) -> None:
        self._projection = projection

    def __call__(self, points: NDArray[Any]) -> list[list[float]]:
        pixels = self._projection(np.asarray(points, dtype=float))
        found: list[list[float]] = np.round(pixels, 1).tolist()
        return found


class _Plain:
    """From metres to a plain background, seen from above as by a camera: y is up."""

    def __init__(self, extent: NDArray[np.float64]) -> None:
        size = np.array(PLAIN_SIZE) * (1 - 2 * MARGIN)
        span = np.maximum(extent[1] - extent[0], 1e-3)
        self._scale = float(np.min(size / span))
        self._middle = extent.mean(axis=0)

    def __call__(self, points: NDArray[Any]) -> list[list[float]]:
        away = (np.asarray(points, dtype=float).reshape(-1, 2) - self._middle) * self._scale
        pixels = np.array(PLAIN_SIZE) / 2 + away * (1, -1)
        found: list[list[float]] = np.round(pixels, 1).tolist()
        return found


def _nowhere(_: NDArray[Any]) -> list[list[float]]:
    """Place nothing: what is measured cannot be drawn into the picture."""
    return []


def _line(points: Any, most: int = PATH_POINTS) -> NDArray[np.float64]:
    """Return the finite ones of some points as (P, 2), thinned to ``most``."""
    line: NDArray[np.float64] = np.asarray(points, dtype=float).reshape(-1, 2)
    line = line[np.isfinite(line).all(axis=1)]
    thinned: NDArray[np.float64] = line[:: max(1, -(-len(line) // most))]
    return thinned


def _first(pixels: list[list[float]]) -> list[float] | None:
    return pixels[0] if pixels else None


def _step(count: int) -> int:
    return max(1, -(-count // MOST_SAMPLES))


def _numbers(values: tuple[float, ...], factor: float, digits: int) -> list[float | None]:
    return [round(v * factor, digits) if math.isfinite(v) else None for v in values]


def _between(
    stamps: NDArray[np.int64], points: NDArray[np.float64], when: int
) -> tuple[float, float] | None:
    """Return the reference (2,) [m] at an instant [ns]; None beside it or across a gap."""
    after = int(np.searchsorted(stamps, when))
    if after == len(stamps) or (after == 0 and stamps[0] != when):
        return None
    if stamps[after] == when:
        return float(points[after, 0]), float(points[after, 1])
    gap = int(stamps[after] - stamps[after - 1])
    if gap > LASTING:
        return None
    share = (when - int(stamps[after - 1])) / gap
    x, y = points[after - 1] + share * (points[after] - points[after - 1])
    return float(x), float(y)


# Called in the worker's process ----------------------------------------------------------------

_open: OrderedDict[str, Playback] = OrderedDict()


def settle() -> None:
    """Do nothing; whoever calls it first starts the process and its imports."""


def describe(path: str) -> bytes:
    """Open a bag, anew if it is open already: it may have grown; return what it is as JSON.

    Raises:
        BagError: it cannot be read, or holds nothing of a limb.
    """
    old = _open.pop(path, None)
    if old is not None:
        old.scenes.close()
    return json.dumps(_opened(path).describe(), separators=(",", ":"), allow_nan=False).encode()


def frame(path: str, at: float) -> bytes:
    """Return picture and overlay of an instant [s] of a bag.

    Raises:
        BagError: it cannot be read.
    """
    return _opened(path).frame(at)


def _opened(path: str) -> Playback:
    if path not in _open:
        while len(_open) >= KEPT:
            _, oldest = _open.popitem(last=False)
            oldest.scenes.close()
        try:
            _open[path] = Playback(path)
        except (OSError, ValueError) as error:
            raise BagError(str(error)) from error
    _open.move_to_end(path)
    return _open[path]
