"""What a bag shows at any instant: the limb, its pressures and the camera's picture, for a slider.

The small messages are read once and kept as numbers; pictures stay in the bag, and each is read
when its instant is asked for.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from der_planner.bags.images import (
    CAMERA_TYPE,
    IMAGE_TYPE,
    LIMB_MARKER,
    MARKERS_TYPE,
    MINIMUM_TAGS,
    TAGS_TYPE,
    Projection,
    TagSights,
    curve_points,
    stamp_of,
    topics_of,
)
from der_planner.bags.reader import BagError, BagReader
from der_planner.bags.record import (
    NANOSECONDS,
    PLAN_TYPE,
    PRESSURE_TYPE,
    STATE_TYPE,
    TRUTH_SUFFIX,
    header_stamp,
    namespace_of,
)

Array = NDArray[np.float64]
Value = TypeVar("Value")

POINT_TYPE = "geometry_msgs/msg/PointStamped"
ESTIMATE_TYPE = "der_msgs/msg/LimbEstimate"
REFERENCE = "tip_reference"
IMAGE_SPAN = NANOSECONDS // 5
"""[ns] of recorded time, each way, in which the picture of an instant is looked for."""
WIDER_SPAN = 2 * NANOSECONDS
"""[ns] in which it is looked for if none is so near."""
ENOUGH_SIGHTS = 50 * MINIMUM_TAGS


class Track(Generic[Value]):
    """Values by the stamps [ns] of their messages."""

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.values: list[Value] = []

    def add(self, stamp: int, value: Value) -> None:
        """Put a value at its place in time; of several of one stamp, the last one counts."""
        if not self.stamps or stamp >= self.stamps[-1]:
            self.stamps.append(stamp)
            self.values.append(value)
            return
        place = bisect.bisect_right(self.stamps, stamp)
        self.stamps.insert(place, stamp)
        self.values.insert(place, value)

    def at(self, when: int, within: int) -> Value | None:
        """Return the newest value at an instant [ns], None if it is older than ``within`` [ns]."""
        place = bisect.bisect_right(self.stamps, when) - 1
        if place < 0 or when - self.stamps[place] > within:
            return None
        return self.values[place]

    def between(self, begin: int, end: int) -> list[Value]:
        """Return the values from one instant to another [ns], both included."""
        first = bisect.bisect_left(self.stamps, begin)
        return self.values[first : bisect.bisect_right(self.stamps, end)]


@dataclass(frozen=True)
class LimbScene:
    """What the tracker said of one image: tip (2,) [m], bend (M,) [rad], curve (N, 2) [m]."""

    valid: bool
    reason: str
    tip: tuple[float, float]
    bend: tuple[float, ...]
    curve: NDArray[np.float32]


@dataclass(frozen=True)
class DriverScene:
    """What the driver said at a tick; pressures in Pa, NaN where unknown."""

    mode: int
    faults: tuple[str, ...]
    commanded: tuple[float, ...]
    measured: tuple[float, ...]
    supply: float


@dataclass(frozen=True)
class PlanScene:
    """A plan: its description, and its tip path (K, 2) [m]."""

    plan_id: str
    motion: str
    model: str
    method: str
    limb: str
    tip: NDArray[np.float32]


@dataclass
class Tracks:
    """Everything small that a bag holds of one limb, by stamps."""

    limb: Track[LimbScene] = field(default_factory=Track)
    driver: Track[DriverScene] = field(default_factory=Track)
    plan: Track[PlanScene] = field(default_factory=Track)
    reference: Track[tuple[float, float]] = field(default_factory=Track)
    planned: Track[NDArray[np.float32]] = field(default_factory=Track)
    estimate: Track[NDArray[np.float32]] = field(default_factory=Track)
    tags: Track[NDArray[np.float32]] = field(default_factory=Track)


@dataclass(frozen=True)
class Picture:
    """A picture as recorded, and its stamp [ns]; ``message`` is the `sensor_msgs/Image`."""

    stamp: int
    message: Any


class Scenes:
    """A bag that is looked at; a context manager, or `close` it.

    Args:
        path: bag folder or file.

    Attributes:
        run: what the recorder was told of the run.
        namespace: of the limb that is shown.
        tracks: its messages.
        projection: from the plane of the limb's tags to pixels; None where the bag lacks the
            camera's calibration or tags.
        start, end: stamps of the first and last message of the tracker, the driver, or, where
            there is neither, the log times of the first and last picture [ns].
        unfinished: its recorder was killed: what is whole of it is shown.

    Raises:
        BagError: nothing readable is there, or nothing of a limb.
    """

    def __init__(self, path: str | Path) -> None:
        self._bag = BagReader(path)
        try:
            self.path = Path(path)
            self.unfinished = self._bag.unfinished
            self.run = self._bag.run()
            self.namespace, self.others = _limbs(self._bag)
            self._image_topic = next(iter(topics_of(self._bag, IMAGE_TYPE, self.namespace)), None)
            sights = TagSights()
            self.tracks = _read(self._bag, self.namespace, sights)
            self.projection: Projection | None = sights.projection()
            self.size = _size(sights.info)
            self.start, self.end = self._span()
        except BagError:
            self.close()
            raise
        except Exception as error:  # rosbags raises many kinds for damaged content
            self.close()
            raise BagError(
                f"the bag {path} is damaged: {error}. scripts/recover_bag.py {path} saves what is "
                "whole"
            ) from error

    def __enter__(self) -> Scenes:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the bag."""
        self._bag.__exit__(None, None, None)

    @property
    def has_pictures(self) -> bool:
        """Whether the camera's pictures were recorded."""
        topic = self._bag.topics.get(self._image_topic or "")
        return topic is not None and topic.message_count > 0

    def picture(self, when: int) -> Picture | None:
        """Return the picture whose stamp is nearest to an instant [ns]; None if none is near.

        Raises:
            BagError: the bag is damaged there.
        """
        if self._image_topic is None:
            return None
        for span in (IMAGE_SPAN, WIDER_SPAN):
            nearest: Picture | None = None
            try:
                for _, _, message in self._bag.messages(
                    [self._image_topic], when - span, when + span
                ):
                    stamp = stamp_of(message)
                    if stamp is None:
                        continue
                    if nearest is None or abs(stamp - when) < abs(nearest.stamp - when):
                        nearest = Picture(stamp, message)
            except Exception as error:  # rosbags raises many kinds for damaged content
                raise BagError(f"the bag {self.path} is damaged here: {error}") from error
            if nearest is not None:
                return nearest
        return None

    def _span(self) -> tuple[int, int]:
        stamps = [track.stamps for track in (self.tracks.limb, self.tracks.driver) if track.stamps]
        if stamps:
            return min(each[0] for each in stamps), max(each[-1] for each in stamps)
        if self.has_pictures:
            return self._bag.start, self._bag.end
        raise BagError(
            f"the bag {self.path} holds neither states of a limb, nor pressures, nor pictures"
        )


def _limbs(bag: BagReader) -> tuple[str, tuple[str, ...]]:
    """Return the namespace of the limb with the most to show, and those of the others."""
    counts: dict[str, int] = {}
    for topic in bag.topics.values():
        if topic.type_name in (STATE_TYPE, PRESSURE_TYPE, PLAN_TYPE) and not topic.name.endswith(
            TRUTH_SUFFIX
        ):
            space = namespace_of(topic.name)
            counts[space] = counts.get(space, 0) + topic.message_count
    ranked = sorted(counts, key=lambda name: (-counts[name], name))
    return (ranked[0], tuple(ranked[1:])) if ranked else ("/limb", ())


def _size(info: Any) -> tuple[int, int] | None:
    return None if info is None else (int(info.width), int(info.height))


def _read(bag: BagReader, namespace: str, sights: TagSights) -> Tracks:
    tracks = Tracks()

    def take_camera(message: Any) -> None:
        sights.info = message

    def take_tags(message: Any) -> None:
        if len(sights.pixels) < ENOUGH_SIGHTS:
            sights.add(message)
        corners = [np.asarray(tag.corners) for tag in message.detections]
        tracks.tags.add(header_stamp(message), np.array(corners, dtype=np.float32).reshape(-1, 8))

    takers: dict[str, Callable[[Any], None]] = {
        STATE_TYPE: lambda message: tracks.limb.add(header_stamp(message), _limb(message)),
        PRESSURE_TYPE: lambda message: tracks.driver.add(header_stamp(message), _driver(message)),
        PLAN_TYPE: lambda message: tracks.plan.add(header_stamp(message), _plan(message)),
        MARKERS_TYPE: lambda message: _take_planned(tracks, message),
        ESTIMATE_TYPE: lambda message: tracks.estimate.add(header_stamp(message), _curve(message)),
        TAGS_TYPE: take_tags,
        CAMERA_TYPE: take_camera,
        POINT_TYPE: lambda message: tracks.reference.add(
            header_stamp(message), (float(message.point.x), float(message.point.y))
        ),
    }
    wanted: dict[str, Callable[[Any], None]] = {}
    for type_name, take in takers.items():
        for name in topics_of(bag, type_name, namespace):
            if type_name != POINT_TYPE or name.endswith(REFERENCE):
                wanted[name] = take
    for name, _, message in bag.messages(list(wanted)):
        wanted[name](message)
    return tracks


def _curve(message: Any) -> NDArray[np.float32]:
    return curve_points(message.curve).astype(np.float32)


def _limb(message: Any) -> LimbScene:
    return LimbScene(
        valid=bool(message.valid),
        reason=str(message.reason),
        tip=(float(message.tip.x), float(message.tip.y)),
        bend=tuple(float(value) for value in message.bend_angle),
        curve=_curve(message),
    )


def _driver(message: Any) -> DriverScene:
    return DriverScene(
        mode=int(message.mode),
        faults=tuple(str(text) for text in message.faults),
        commanded=tuple(float(value) for value in message.commanded_differential),
        measured=tuple(float(value) for value in message.measured_differential),
        supply=float(getattr(message, "supply_pressure", float("nan"))),
    )


def _plan(message: Any) -> PlanScene:
    return PlanScene(
        plan_id=str(message.plan_id),
        motion=str(message.motion),
        model=str(message.model),
        method=str(message.method),
        limb=str(message.limb),
        tip=np.array(message.tip_reference, dtype=np.float32).reshape(-1, 2),
    )


def _take_planned(tracks: Tracks, message: Any) -> None:
    for marker in message.markers:
        if marker.ns == LIMB_MARKER:
            points = curve_points(marker.points).astype(np.float32)
            tracks.planned.add(header_stamp(marker), points)
            return
