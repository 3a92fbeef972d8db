"""The body map: which tracked rigid body sits where on the limb and around it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from apriltag_tracker.tag_map import (
    Lengths,
    LimbGeometry,
    MapError,
    Stretches,
    check_keys,
    floats,
    on_limb,
    section,
)

if TYPE_CHECKING:
    from typing_extensions import Self  # `typing` has it from Python 3.11 on

LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
"""[m] of each unit in which positions may come."""
_KEYS = {"name", "place", "arc_length", "position", "height", "offset", "rotation"}


@dataclass(frozen=True)
class BodyOnLimb:
    """A rigid body on the limb.

    Attributes:
        name: as its tracker calls it.
        arc_length: of its origin from the clamp along the centreline [m].
        height: of its origin above the base plane [m].
        offset: of its origin along and across the limb [m, m], and of its direction [rad], against
            where `arc_length` says it is.
        rotation: (3, 3) its axes, as columns, in the frame of the centreline there: x along the
            limb, z up.
    """

    name: str
    arc_length: float
    height: float
    offset: tuple[float, float, float]
    rotation: NDArray[np.float64]


@dataclass(frozen=True)
class FixedBody:
    """A rigid body that does not move: on the clamp, or around the limb.

    Attributes:
        name: as its tracker calls it.
        position: (3,) of its origin in `limb_base` [m].
        rotation: (3, 3) its axes, as columns, in `limb_base`; None if they are not known.
    """

    name: str
    position: NDArray[np.float64]
    rotation: NDArray[np.float64] | None


@dataclass(frozen=True)
class BaseFrame:
    """Where `limb_base` is in the frame of the poses: p_base = rotation p + translation [m]."""

    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    def of(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points (n, 3) of the poses' frame [m] in `limb_base`."""
        return np.asarray(points @ self.rotation.T + self.translation, dtype=np.float64)

    @classmethod
    def from_mapping(cls, entry: dict[str, Any]) -> BaseFrame:
        """Read where the origin and the axes of `limb_base` are in the frame of the poses, in m.

        Raises:
            MapError: a key is missing or impossible.
        """
        origin = np.array(floats(entry.get("position"), 3, "frame: position"))
        rotation = _rotation(entry.get("rotation"), "frame").T
        return cls(rotation, -rotation @ origin)


@dataclass(frozen=True)
class BodyMap(LimbGeometry):
    """All bodies of a set-up.

    Attributes:
        limb: bodies on it.
        fixed: bodies on the clamp and around the limb.
        names: of all bodies in the order in which the file lists them, which is that of a message
            without names.
        unit: [m] of a unit of length of the poses.
        frame: where `limb_base` is, for a set-up without enough fixed bodies; None: from these.
    """

    limb: tuple[BodyOnLimb, ...]
    fixed: tuple[FixedBody, ...]
    names: tuple[str, ...]
    unit: float = 1.0
    frame: BaseFrame | None = None

    @property
    def limb_names(self) -> dict[int, str]:
        """Names of the limb's bodies by their ids, which are their places in ``limb``."""
        return {place: body.name for place, body in enumerate(self.limb)}

    @classmethod
    def _read(cls, data: dict[str, Any], lengths: Lengths, stiff: Stretches) -> Self:
        unit = str(data.get("length_unit", "m"))
        if unit not in LENGTH_UNITS:
            raise MapError(f"length_unit is '{unit}': choose {', '.join(LENGTH_UNITS)}")
        entries = data.get("bodies")
        if not isinstance(entries, list):
            raise MapError("bodies: a list of entries 'name: …, arc_length: …' expected")
        found = [_body(entry, sum(lengths)) for entry in entries]
        names = tuple(body.name for body in found)
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise MapError(f"bodies {', '.join(twice)} are listed twice: each has its own name")
        limb = tuple(body for body in found if isinstance(body, BodyOnLimb))
        if not limb:
            raise MapError("bodies: at least one must have an arc_length on the limb")
        fixed = tuple(body for body in found if isinstance(body, FixedBody))
        frame = BaseFrame.from_mapping(section(data, "frame")) if "frame" in data else None
        if not fixed and frame is None:
            raise MapError(
                "bodies: at least one must have 'place: clamp' or 'place: world', or the key frame "
                "must say where limb_base is"
            )
        return cls(lengths, limb, fixed, names, LENGTH_UNITS[unit], frame, stiff=stiff)


def _body(entry: Any, total: float) -> BodyOnLimb | FixedBody:
    if not isinstance(entry, dict) or not isinstance(entry.get("name"), str):
        raise MapError(f"bodies: an entry 'name: …, arc_length: …' expected, not {entry!r}")
    name = f"body {entry['name']}"
    check_keys(entry, _KEYS, name)
    turn = _rotation(entry["rotation"], name) if "rotation" in entry else None
    if "arc_length" not in entry:
        if entry.get("place") not in ("clamp", "world"):
            raise MapError(f"{name}: an arc_length, or 'place: clamp' or 'place: world' needed")
        position = floats(entry.get("position"), 3, f"{name}: position")
        return FixedBody(entry["name"], np.array(position), turn)
    place = on_limb({"height": 0.0, **entry}, total, name)
    return BodyOnLimb(entry["name"], *place, np.eye(3) if turn is None else turn)


def _rotation(value: Any, name: str) -> NDArray[np.float64]:
    quaternion = np.array(floats(value, 4, f"{name}: rotation"))
    if not 0.99 < float(np.linalg.norm(quaternion)) < 1.01:
        raise MapError(f"{name}: rotation {value} is no quaternion x, y, z, w of length 1")
    return np.asarray(Rotation.from_quat(quaternion).as_matrix(), dtype=np.float64)
