"""Drawn paths: what the tip reaches, what a drawing would look like if it were played, and files.

Previews are planned in a process of their own, so that the page and its vent stay alive.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import re
import signal
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.limb import Limb, Load
from der_planner.model import ArcModel
from der_planner.planning import (
    Motion,
    PathLimits,
    PlanningError,
    Workspace,
    plan,
)
from der_planner.planning.paths import read_csv

MOST_POINTS = 20_000
"""A drawing has at most this many points."""
LONGEST_NAME = 60
REGIONS_KEPT = 8
"""The reachable regions of this many loads are remembered."""
FRAMES = 60
"""A preview holds this many poses of the predicted limb."""
PATH_POINTS = 200
NICENESS = 5
"""Niceness of the process that plans previews: the graph's nodes go first."""
_PR_SET_PDEATHSIG = 1
_CELLS = 500
"""The longer side of the picture in which the region is drawn has this many pixels."""
_POSES = 40_000
_NO_NAME = re.compile(r"[^\w-]+")
"""Letters and digits of any language may stand in a file's name; a folder's marks may not."""


class DrawingError(ValueError):
    """A drawing cannot be kept or read; the message says why."""


def drawn_pixels(sent: Any) -> Array:
    """Return what a browser says it has drawn as points (P, 2) [px].

    Raises:
        DrawingError: it is no list of two or more pairs of finite numbers.
    """
    try:
        points = np.array(sent, dtype=float)
    except (TypeError, ValueError) as error:
        raise DrawingError("a drawing must be a list of points") from error
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
        raise DrawingError("draw a line: a drawing needs two points or more")
    if len(points) > MOST_POINTS:
        raise DrawingError(f"a drawing may have {MOST_POINTS} points: draw less at once")
    if not np.all(np.isfinite(points)):
        raise DrawingError("a point of the drawing is not finite")
    return points


class DrawingFolder:
    """A folder of drawings: CSV files that `run_experiment.py --path` reads, too.

    Args:
        folder: made when the first drawing is kept.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def names(self) -> list[str]:
        """Return the names of all drawings."""
        return sorted(path.stem for path in self._folder.glob("*.csv") if path.is_file())

    def save(self, name: str, tip: Array) -> Path:
        """Keep points (P, 2) [m]; return the file, whose name has only letters and digits.

        Raises:
            DrawingError: no usable name, there is one of that name, or the folder cannot be used.
        """
        stem = _NO_NAME.sub("_", name.strip()).strip("_-")[:LONGEST_NAME]
        if not stem:
            raise DrawingError("a drawing needs a name with letters or digits")
        file = self._folder / f"{stem}.csv"
        lines = [f"{x * 100:.4f}, {y * 100:.4f}" for x, y in tip]
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with file.open("x") as stream:
                stream.write("\n".join(["x [cm], y [cm]", *lines]) + "\n")
        except FileExistsError as error:
            text = f"there is a drawing '{stem}' already: choose another name"
            raise DrawingError(text) from error
        except OSError as error:
            raise DrawingError(f"cannot write into {self._folder}: {error.strerror}") from error
        return file

    def load(self, name: str) -> Array:
        """Return the points (P, 2) [m] of a drawing.

        Raises:
            DrawingError: there is none of that name, or its file is no path.
        """
        if name not in self.names():  # so that no name leads out of the folder
            raise DrawingError(f"there is no drawing '{name}' in {self._folder}")
        file = self._folder / f"{name}.csv"
        try:
            _, tip = read_csv(file)
        except PlanningError as error:
            raise DrawingError(str(error)) from error
        if len(tip) > MOST_POINTS:
            raise DrawingError(f"{file} has {len(tip)} points: {MOST_POINTS} at most can be shown")
        return tip


@dataclass(frozen=True)
class Preview:
    """A planned drawing.

    Attributes:
        path: (P, 2) what the tip follows: the nearest path, with the ways there and back [m].
        poses: centrelines (N, 2) [m] of the predicted limb, evenly spaced in time.
        duration: [s].
        largest_pressure: largest |command| [Pa].
        predicted_error: mean distance of the predicted tip from the path [m].
        deviation: how far the path is from the drawing, in words; empty if it follows it.
        warnings: of the plan, without the deviation.
        problem: why there is no plan; empty if there is one.
        place: (x, y) of the point of the drawing that is the reason [m]; None: it is none.
    """

    path: Array
    poses: tuple[Array, ...] = ()
    duration: float = 0.0
    largest_pressure: float = 0.0
    predicted_error: float = 0.0
    deviation: str = ""
    warnings: tuple[str, ...] = ()
    problem: str = ""
    place: tuple[float, float] | None = None


def preview(limb: Limb, tip: Array, limits: PathLimits, model: str, method: str) -> Preview:
    """Plan a drawing (P, 2) [m] as the planner node would."""
    try:
        motion = Motion.from_tip_path(None, tip, limits=limits, nearest=True)
        planned = plan(limb, motion, model, method)
    except PlanningError as error:
        # Of a point that is out of reach, and of a load that is too much there.
        place: tuple[float, float] | None = getattr(error, "point", None)
        return Preview(np.empty((0, 2)), problem=str(error), place=place)
    deviation = str(planned.reference.deviation or "")
    frames = np.linspace(0, len(planned.time) - 1, min(FRAMES, len(planned.time))).astype(int)
    return Preview(
        path=planned.tip_reference[:: max(1, len(planned.time) // PATH_POINTS)],
        poses=tuple(planned.curve(int(k)) for k in frames),
        duration=planned.duration,
        largest_pressure=float(np.abs(planned.differential_pressure).max()),
        predicted_error=planned.predicted_error,
        deviation=deviation,
        warnings=tuple(text for text in planned.warnings if text != deviation),
    )


class Previewer:
    """Says what a limb reaches and how it would follow a drawing, under the loads of a command.

    Args:
        limb: that draws, mounted as the planner's.
        limits: of the tip, as the planner has them.
        carried: the planner's payload, and where; its mounting is the limb's already.

    Raises:
        LimbError: the limb cannot carry the payload.
    """

    def __init__(self, limb: Limb, limits: PathLimits, carried: Load) -> None:
        self.limb = limb
        self._limits = limits
        self._carried = carried
        self._process: ProcessPoolExecutor | None = None
        self.region = lru_cache(REGIONS_KEPT)(lambda load: reachable_region(self.limb_under(load)))
        self.limb_under(carried)

    def follow(self, limb: Limb) -> None:
        """Draw from now on with another limb, mounted as the planner's."""
        self.limb = limb
        self.region.cache_clear()

    def limb_under(self, load: Load) -> Limb:
        """Return the limb as the planner would have it for a command of this load.

        Raises:
            LimbError: no such mounting, or no such place on the limb.
        """
        carried = load if load.payload else self._carried
        return self.limb.loaded(carried._replace(mounting=load.mounting))

    def ask(self, limb: Limb, tip: Array, model: str = "der", method: str = "") -> Future[Preview]:
        """Plan a drawing (P, 2) [m] for a limb; the first starts the process and takes longer."""
        arguments = (limb, tip, self._limits, model, method)
        if self._process is not None:
            with contextlib.suppress(BrokenProcessPool):  # it has died: a new one is started
                return self._process.submit(preview, *arguments)
        spawn = multiprocessing.get_context("spawn")
        self._process = ProcessPoolExecutor(1, spawn, initializer=_prepare_process)
        return self._process.submit(preview, *arguments)

    def close(self) -> None:
        """End the process, also in the middle of a plan."""
        if self._process is not None:
            workers = list((self._process._processes or {}).values())
            self._process.shutdown(wait=False, cancel_futures=True)
            for worker in workers:
                worker.kill()


def _prepare_process() -> None:
    """Leave interrupts to the page, end with it whatever ends it, and let others go first."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    os.nice(NICENESS)


def reachable_region(limb: Limb) -> list[Array]:
    """Return the outlines (P, 2) [m] of what the tip of constant-curvature arcs reaches.

    The bend angles within the pressure limit are cut into small cells; the tips of each cell's
    corners are filled in a picture, whose outlines are returned. They are right to a five-hundredth
    of the region's size. Weight that bends the limb counts as `static_pressure` does.

    Args:
        limb: for its arcs and pressure limit.
    """
    count = limb.segment_count
    space = Workspace(ArcModel(limb))
    size = max(4, round(_POSES ** (1 / max(count, 2))))
    axes = [np.linspace(a, b, size) for a, b in zip(space.low, space.high, strict=True)]
    poses = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    tips = space.arcs.tip(poses)
    limit = limb.pneumatics.pressure_limit * (1 + 1e-9)
    allowed: NDArray[np.bool_] = np.all(np.abs(space.arcs.static_pressure(poses)) <= limit, axis=-1)
    if not allowed.any():
        return []
    corner = tips[allowed].min(axis=0)
    cell = max(float(np.ptp(tips[allowed], axis=0).max()) / _CELLS, 1e-6)
    pixels = np.round((tips - corner) / cell).astype(np.int32) + 2
    width, height = pixels[allowed].max(axis=0) + 3
    picture = np.zeros((height, width), np.uint8)
    for face in _faces(pixels, allowed):
        cv2.fillConvexPoly(picture, cv2.convexHull(face), 255)
    # Between the cells' own roundings.
    picture = cv2.morphologyEx(picture, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    outlines, _ = cv2.findContours(picture, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    smooth = [cv2.approxPolyDP(outline, 0.7, closed=True) for outline in outlines]
    return [(line[:, 0] - 2.0) * cell + corner for line in smooth if len(line) > 2]


def _faces(pixels: NDArray[np.int32], allowed: NDArray[np.bool_]) -> list[NDArray[np.int32]]:
    """Return the corners (4, 2) of each face of the grid of poses whose corners are all allowed."""
    count = allowed.ndim
    if count == 1:
        return [pixels[k : k + 2] for k in range(len(pixels) - 1)]
    found = []
    for first in range(count):
        for second in range(first + 1, count):
            turned = np.moveaxis(pixels, (first, second), (0, 1))
            ok = np.moveaxis(allowed, (first, second), (0, 1))
            good = ok[:-1, :-1] & ok[1:, :-1] & ok[1:, 1:] & ok[:-1, 1:]
            parts = (turned[:-1, :-1], turned[1:, :-1], turned[1:, 1:], turned[:-1, 1:])
            found.append(np.stack([part[good] for part in parts], axis=1))
    return list(np.concatenate(found))
