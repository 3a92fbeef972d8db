"""The tag map: which tag sits where on the limb and around it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from numpy.typing import NDArray

from apriltag_tracker import family as families
from apriltag_tracker.family import TAG36H11, Family
from apriltag_tracker.pose.curve import Curve

if TYPE_CHECKING:
    from typing_extensions import Self  # `typing` has it from Python 3.11 on

Lengths = tuple[float, ...]
"""Of the segments [m]."""
Stretches = tuple[tuple[float, float], ...]
"""From and to in arc length [m]."""
SCHEMA_VERSION = 1
LONGEST = 5.0
"""Length of a segment from which on it is told in another unit [m]."""

UNIT_CORNERS = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
"""Corners of a tag of size 1 in its own frame: lower left, lower right, upper right, upper left."""


class MapError(ValueError):
    """The tag map is incomplete or impossible; the message names file, key and remedy."""


@dataclass(frozen=True)
class LimbTag:
    """A tag on the limb.

    Attributes:
        id: within the family.
        arc_length: of its centre from the clamp along the centreline [m].
        height: above the base plane [m].
        size: edge of the border, black or white, that the family has [m].
        offset: mounting offset of the centre along and across the limb [m, m] and of its direction
            [rad], against where `arc_length` says it is.
    """

    id: int
    arc_length: float
    height: float
    size: float
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class WorldTag:
    """A fixed tag: position of its centre in `limb_base` [m], yaw [rad] and border size [m]."""

    id: int
    position: tuple[float, float, float]
    yaw: float
    size: float

    def corners(self) -> NDArray[np.float64]:
        """Return the corners in `limb_base`, (4, 3) m, lower left first, counter-clockwise."""
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        turned = UNIT_CORNERS @ np.array([[cosine, sine], [-sine, cosine]]) * self.size
        return np.asarray(np.column_stack([turned, np.zeros(4)]) + self.position)


@dataclass(frozen=True)
class LimbGeometry(ABC):
    """What a map says of the limb, whatever sits on it.

    Attributes:
        segment_lengths: of the limb at rest [m].
        stiff: stretches that cannot bend, from and to in arc length [m].
    """

    segment_lengths: Lengths
    stiff: Stretches = field(default=(), kw_only=True)

    @property
    def length(self) -> float:
        """Arc length of the tip at rest [m]."""
        return sum(self.segment_lengths)

    @property
    @abstractmethod
    def limb_names(self) -> dict[int, str]:
        """Names of what is on the limb, by id, in the order of the map."""

    @classmethod
    def from_yaml(cls, path: str | Path) -> Self:
        """Read a map.

        Raises:
            MapError: the file is missing, is no YAML, or a key is missing or impossible.
        """
        try:
            return cls.from_dict(yaml.safe_load(Path(path).read_text()))
        except OSError as error:
            raise MapError(f"cannot read the map {path}: {error.strerror}") from error
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise MapError(f"the map {path} is not YAML: {error}") from error
        except MapError as error:
            raise MapError(f"{path}: {error}") from error

    @classmethod
    def from_dict(cls, data: Any) -> Self:
        """Build a map from the content of its file.

        Raises:
            MapError: a key is missing or impossible.
        """
        if not isinstance(data, dict) or data.get("schema") != SCHEMA_VERSION:
            raise MapError(f"'schema: {SCHEMA_VERSION}' expected at the top of the map")
        limb = section(data, "limb")
        lengths = tuple(floats(limb.get("segment_lengths"), None, "limb.segment_lengths"))
        if not lengths or not 0.0 < min(lengths) <= max(lengths) < LONGEST:
            raise MapError(
                f"limb.segment_lengths: a list of lengths in m expected, each below {LONGEST:g} m"
            )
        return cls._read(data, lengths, _stiff(limb.get("stiff") or [], lengths))

    @classmethod
    @abstractmethod
    def _read(cls, data: dict[str, Any], lengths: Lengths, stiff: Stretches) -> Self:
        """Read what sits on a limb of known geometry and around it; raises `MapError`."""


@dataclass(frozen=True)
class TagMap(LimbGeometry):
    """All tags of a set-up.

    Attributes:
        limb: tags on it.
        world: fixed tags.
        family: of all tags.
    """

    limb: tuple[LimbTag, ...]
    world: tuple[WorldTag, ...]
    family: Family = TAG36H11

    def __post_init__(self) -> None:
        twice = sorted({tag for tag in self.ids if self.ids.count(tag) > 1})
        if twice:
            raise MapError(
                f"tag ids {twice} occur twice in the tag map: every tag needs its own id"
            )
        count = self.family.tag_count
        if foreign := [tag for tag in self.ids if not 0 <= tag < count]:
            raise MapError(
                f"tag ids {foreign} are none of 0 to {count - 1}, which {self.family.name} has: "
                "take a tag map with ids of the family (--tag-map, parameter tag_map)"
            )

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of all tags, those of the limb first."""
        return tuple(tag.id for tag in self.limb) + tuple(tag.id for tag in self.world)

    @property
    def limb_names(self) -> dict[int, str]:
        """Names of the limb's tags by their ids."""
        return {tag.id: str(tag.id) for tag in self.limb}

    @classmethod
    def _read(cls, data: dict[str, Any], lengths: Lengths, stiff: Stretches) -> Self:
        try:
            family = families.named(data.get("family"))
        except ValueError as error:
            raise MapError(str(error)) from error
        limb, world = section(data, "limb"), section(data, "world")
        limb_tags = tuple(_limb_tag(entry, sum(lengths)) for entry in limb.get("tags") or [])
        if not limb_tags:
            raise MapError("limb.tags is empty: at least one tag must be on the limb")
        world_tags = tuple(_world_tag(entry) for entry in world.get("tags") or [])
        if not world_tags:
            raise MapError("world.tags is empty: fixed tags tell where the camera is")
        return cls(lengths, limb_tags, world_tags, family, stiff=stiff)


def on_limb(
    entry: dict[str, Any], total: float, name: str
) -> tuple[float, float, tuple[float, float, float]]:
    """Read arc length [m], height [m] and offset of what is on the limb; raises `MapError`."""
    arc_length = number(entry.get("arc_length"), f"{name}: arc_length")
    if not 0.0 <= arc_length <= total:
        raise MapError(f"{name}: arc_length {arc_length} m is not on the limb (0 to {total} m)")
    height = number(entry.get("height"), f"{name}: height")
    along, across, angle = floats(entry.get("offset", [0.0, 0.0, 0.0]), 3, f"{name}: offset")
    return arc_length, height, (along, across, angle)


def check_keys(entry: dict[str, Any], known: set[str], name: str) -> None:
    """Refuse keys of an entry that nobody reads; raises `MapError`."""
    if unknown := sorted(map(str, entry.keys() - known)):
        raise MapError(f"{name}: unknown key '{unknown[0]}'; known: {', '.join(sorted(known))}")


def section(data: dict[str, Any], name: str) -> dict[str, Any]:
    """Return a part of a map that must be there; raises `MapError`."""
    found = data.get(name)
    if not isinstance(found, dict):
        raise MapError(f"section '{name}' is missing")
    return found


def floats(value: Any, count: int | None, name: str) -> list[float]:
    """Return a list of ``count`` finite numbers, of any count if None; raises `MapError`."""
    if not isinstance(value, list) or (count is not None and len(value) != count):
        raise MapError(f"{name}: a list of {count or 'some'} numbers expected, not {value!r}")
    return [number(entry, name) for entry in value]


def number(value: Any, name: str) -> float:
    """Return a finite number; raises `MapError`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise MapError(f"{name}: a finite number expected, not {value!r}")
    return float(value)


def _stiff(value: Any, lengths: Lengths) -> Stretches:
    result: list[tuple[float, float]] = []
    for entry in value if isinstance(value, list) else [value]:
        start, end = floats(entry, 2, "limb.stiff")
        if not (result[-1][1] if result else 0.0) <= start < end <= sum(lengths) + 1e-9:
            raise MapError(f"limb.stiff: {entry} is out of order or not on the limb")
        result.append((start, end))
    if np.any(Curve(lengths, 0, result).active < 0.5 * np.array(lengths)):
        raise MapError("limb.stiff covers more than half of a segment: nothing could bend")
    return tuple(result)


def _common(entry: Any, where: str, keys: set[str]) -> tuple[int, float, str]:
    if not isinstance(entry, dict):
        raise MapError(f"{where}: an entry 'id: …, size: …' expected, not {entry!r}")
    tag = entry.get("id")
    if isinstance(tag, bool) or not isinstance(tag, int):
        raise MapError(f"{where}: id {tag!r} is no whole number")
    name = f"{where} {tag}"
    check_keys(entry, keys | {"id", "size"}, name)
    size = number(entry.get("size"), f"{name}: size")
    if size <= 0.0:
        raise MapError(f"{name}: size {size} m must be positive")
    return tag, size, name


def _limb_tag(entry: Any, total: float) -> LimbTag:
    tag, size, name = _common(entry, "limb tag", {"arc_length", "height", "offset"})
    arc_length, height, offset = on_limb(entry, total, name)
    return LimbTag(tag, arc_length, height, size, offset)


def _world_tag(entry: Any) -> WorldTag:
    tag, size, name = _common(entry, "world tag", {"position", "yaw"})
    position = floats(entry.get("position"), 3, f"{name}: position")
    yaw = number(entry.get("yaw", 0.0), f"{name}: yaw")
    return WorldTag(tag, (position[0], position[1], position[2]), yaw, size)
