"""The limb at chosen instants of a recorded run: camera frame, measured and planned shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from der_planner.bags.images import (
    CAMERA_TYPE,
    IMAGE_TYPE,
    LIMB_MARKER,
    MARKERS_TYPE,
    TAGS_TYPE,
    Projection,
    TagSights,
    curve_points,
    gray,
    stamp_of,
    topics_of,
)
from der_planner.bags.reader import BagReader
from der_planner.bags.record import NANOSECONDS, STATE_TYPE
from der_planner.bags.run import Array, RunSeries

MARGIN = 0.5
"""Messages within so many seconds of an instant may belong to it."""


@dataclass(frozen=True)
class Snapshot:
    """The limb at one instant.

    Attributes:
        time: asked for [s] since the first setpoint.
        frame: (H, W) gray image nearest in time, or None where the bag has no images.
        measured: (N, 2) curve of the tracker [m], empty where it had none.
        planned: (N, 2) curve of the planner's reference limb [m], empty where it published none.
    """

    time: float
    frame: NDArray[np.uint8] | None
    measured: Array
    planned: Array


def take_snapshots(run: RunSeries, times: Sequence[float]) -> list[Snapshot]:
    """Read the limb's shape, and the frames where there are any, at some instants of a bag.

    Args:
        run: of a bag.
        times: [s] since the first setpoint.

    Raises:
        BagError: the bag cannot be read.
    """
    with BagReader(run.description.bag) as bag:
        return [_snapshot(bag, run, time) for time in times]


def _snapshot(bag: BagReader, run: RunSeries, time: float) -> Snapshot:
    space = run.description.namespace
    when = run.origin + round(time * NANOSECONDS)
    window = (when - round(MARGIN * NANOSECONDS), when + round(MARGIN * NANOSECONDS))
    states, images = topics_of(bag, STATE_TYPE, space)[:1], topics_of(bag, IMAGE_TYPE, space)[:1]
    markers = topics_of(bag, MARKERS_TYPE, space)[:1]
    nearest: dict[str, tuple[int, Any]] = {}
    for topic, _, message in bag.messages([*states, *images, *markers], *window):
        stamp = stamp_of(message)
        if stamp is None:
            continue
        away = abs(stamp - when)
        if topic not in nearest or away < nearest[topic][0]:
            nearest[topic] = (away, message)
    found = {topic: message for topic, (_, message) in nearest.items()}
    state = next((found[name] for name in states if name in found), None)
    image = next((found[name] for name in images if name in found), None)
    marker = next((found[name] for name in markers if name in found), None)
    return Snapshot(
        time=time,
        frame=gray(image) if image is not None else None,
        measured=curve_points(state.curve)
        if state is not None and state.valid
        else np.empty((0, 2)),
        planned=_limb_of(marker),
    )


def _limb_of(message: Any) -> Array:
    if message is None:
        return np.empty((0, 2))
    return curve_points(
        next(marker.points for marker in message.markers if marker.ns == LIMB_MARKER)
    )


def fit_projection(run: RunSeries, seconds: float = 60.0) -> Projection | None:
    """Fit the projection to the limb tags of the first part of a run.

    Args:
        run: of a bag.
        seconds: how much of the run to read.

    Returns:
        None where the bag lacks the camera's calibration or has too few tags.
    """
    with BagReader(run.description.bag) as bag:
        space = run.description.namespace
        cameras, tags = topics_of(bag, CAMERA_TYPE, space)[:1], topics_of(bag, TAGS_TYPE, space)[:1]
        sights = TagSights()
        last = run.origin + round(seconds * NANOSECONDS)
        for topic, _, message in bag.messages([*cameras, *tags], None, last):
            if topic in cameras:
                sights.info = message
            else:
                sights.add(message)
    return sights.projection()
