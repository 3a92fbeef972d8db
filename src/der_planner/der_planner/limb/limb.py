"""One robot: every physical parameter of a limb, validated, from and to YAML.

All values are SI. A limb file names the unit of each key, carries a schema version and says where
its numbers come from, so that the nodes of one run and the runs of one lab share a single
description.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from der_planner.files import read_yaml, write_whole, yaml_text
from der_planner.limb.declaration import LimbError, check, commented, effect, parameter, read
from der_planner.limb.loads import (
    BEYOND_THE_TIP,
    HEAVIEST,
    PAYLOAD,
    Load,
    PointMass,
    gravity_of,
    mounting_of,
)
from der_planner.limb.parameters import CalibratedRange, Pneumatics, Segment

SCHEMA_VERSION = 1
MOST_CARRIED = 10.0
"""Largest payload over what the limb weighs: more is a mistake in the unit."""
LEAST_BEND, MOST_BEND = 0.01, 15.0
"""Bend of a segment at the pressure limit that a limb can have [rad]."""
SLOWEST = 60.0
"""Largest time in which chambers follow their command, or fill at the slew limit [s]."""
DEFAULT_LIMB_FILE = Path(__file__).resolve().parents[1] / "data" / "default_limb.yaml"


@dataclass(frozen=True)
class Limb:
    """A planar pneumatic limb of M segments in the frame `limb_base`.

    Attributes:
        name: of the robot.
        segments: (M,) from the clamp to the tip.
        pneumatics: of all chamber pairs.
        calibrated: what the numbers were identified on.
        provenance: free text by key: source, date, bag, residuals.
        pcc_segments: (M,) what the same data say of the PCC model, where that differs; empty: as
            `segments`.
        masses: that the limb carries at places of its centreline, beside its distributed mass.
    """

    name: str
    segments: tuple[Segment, ...]
    pneumatics: Pneumatics
    connector_length: float = effect(
        "m",
        "straight passive piece between two segments",
        "measure it; 0 lets the rod's mesh choose one edge that belongs to neither segment",
    )
    gravity: tuple[float, float, float] = parameter(
        "m/s²",
        "acceleration in limb_base: x along the straight limb, y to its left",
        "zeros for a limb that lies on a plate, [9.81, 0, 0] for one that hangs from its "
        "clamp, [0, 0, -9.81] for one that is level and free to sag out of its plane",
        default=(0.0, 0.0, 0.0),
        interval="[-20, 20]",
    )
    calibrated: CalibratedRange = field(default_factory=CalibratedRange)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    pcc_segments: tuple[Segment, ...] = ()
    base_length: float = effect(
        "m",
        "straight passive piece between the clamp and the first segment",
        "measure it; the calibration corrects it by the tip",
    )
    masses: tuple[PointMass, ...] = ()

    def __post_init__(self) -> None:
        if not self.segments:
            raise LimbError(f"limb '{self.name}' has no segments: give at least one")
        for key in ("segments", "pcc_segments"):
            for index, segment in enumerate(getattr(self, key)):
                check(segment, f"{key}[{index}].")
        if self.pcc_segments and len(self.pcc_segments) != len(self.segments):
            raise LimbError(
                f"pcc_segments has {len(self.pcc_segments)} entries, segments {len(self.segments)}"
            )
        check(self.pneumatics, "pneumatics.")
        if len(self.gravity) != 3:
            raise LimbError(f"gravity must be three numbers in m/s², got {self.gravity}")
        check(self.calibrated, "calibrated.")
        if len(self.calibrated.gravity) not in (0, 3):
            given = self.calibrated.gravity
            raise LimbError(f"calibrated.gravity must be three numbers in m/s² or [], got {given}")
        check(self)
        for index, item in enumerate(self.masses):
            check(item, f"masses[{index}].")
            self._check_place(f"masses[{index}].arc_length", item.arc_length)

    def _check_units(self) -> None:
        """Refuse what no limb has: one of its numbers is in another unit."""
        air = self.pneumatics
        for index, bend in enumerate(self.static_gain * air.pressure_limit):
            if not LEAST_BEND < bend < MOST_BEND:
                raise LimbError(
                    f"segments[{index}] would bend by {bend:.2g} rad at the pressure limit: give "
                    "bending_stiffness in N·m², moment_gain in N·m/Pa, length in m and "
                    "pressure_limit in Pa"
                )
        if self.mass > min(HEAVIEST, (1.0 + MOST_CARRIED) * self._own_mass):
            raise LimbError(
                f"the limb weighs {self.mass:.3g} kg: give mass_per_length in kg/m, masses in kg"
            )
        slowest = max(air.time_constant, air.vent_time_constant, air.delay)
        if max(slowest, air.pressure_limit / air.slew_limit) > SLOWEST:
            raise LimbError(
                f"the chambers would take more than {SLOWEST:.0f} s: give time_constant and delay "
                "in s, slew_limit in Pa/s"
            )

    def _check_place(self, what: str, arc_length: float) -> None:
        """Refuse a mass beyond the limb."""
        if arc_length > self.length * (1 + 1e-9):
            raise LimbError(
                f"{what} must be at most the limb's length of {self.length:.6g} m, got {arc_length}"
            )

    @property
    def segment_count(self) -> int:
        """M, the number of segments and of differential pressures."""
        return len(self.segments)

    @property
    def length(self) -> float:
        """Length from the clamp to the tip at rest [m]."""
        connectors = (self.segment_count - 1) * self.connector_length
        return self.base_length + sum(segment.length for segment in self.segments) + connectors

    @property
    def mass(self) -> float:
        """What a scale shows from the clamp on, everything that the limb carries included [kg]."""
        return self._own_mass + sum(item.mass for item in self.masses)

    @property
    def moving_mass(self) -> float:
        """The part of `mass` beyond the stiff base: what bends the limb by its weight [kg]."""
        carried = sum(item.mass for item in self.masses if item.arc_length > self.base_length)
        return self._own_mass - self.segments[0].mass_per_length * self.base_length + carried

    @property
    def _own_mass(self) -> float:
        """The distributed mass: base, segments and connectors [kg]."""
        densities = [segment.mass_per_length for segment in self.segments]
        own = densities[0] * self.base_length
        own += sum(s.mass_per_length * s.length for s in self.segments)
        return own + self.connector_length * sum(0.5 * (a + b) for a, b in pairwise(densities))

    @property
    def weighs_in_plane(self) -> bool:
        """Whether gravity pulls in the plane of motion."""
        return any(self.gravity[:2])

    @property
    def tip_force(self) -> float:
        """What the strongest segment, at the pressure limit, presses with at the tip [N]."""
        gain = max(segment.moment_gain for segment in self.segments)
        return gain * self.pneumatics.pressure_limit / self.length

    @property
    def static_gain(self) -> NDArray[np.float64]:
        """(M,) `Segment.static_gain` [rad/Pa]."""
        return np.array([segment.static_gain for segment in self.segments])

    def for_model(self, model: str) -> Limb:
        """Return the limb as a model sees it: "pcc" with its own segments, if any."""
        if model not in ("der", "pcc"):
            raise LimbError(f"model must be 'der' or 'pcc', got {model!r}")
        if model == "der" or not self.pcc_segments:
            return self
        return dataclasses.replace(self, segments=self.pcc_segments, pcc_segments=())

    def weighing(self, mass: float) -> Limb:
        """Return the limb with as much mass per length as makes it weigh this much.

        Its `masses` are part of what was weighed and stay; the rest is spread as it was.

        Args:
            mass: from the clamp on, fittings, tubes and tags included, without a payload [kg].

        Raises:
            LimbError: it is not a number, far from what the file says, or the limb's `masses` alone
                are as heavy.
        """
        fittings = sum(item.mass for item in self.masses)
        if not math.isfinite(mass) or mass <= fittings:
            raise LimbError(
                f"the limb is said to weigh {mass:g} kg: it must be more than the {fittings:g} kg "
                "of its masses, which are part of it"
            )
        factor = (mass - fittings) / self._own_mass
        if not 1.0 / MOST_CARRIED <= factor <= MOST_CARRIED:
            raise LimbError(
                f"{mass:g} kg are {factor:.4g} times what the limb file says, {self.mass:.3g} kg: "
                "give kg"
            )
        return self.scaled("mass_per_length", factor)

    def scaled(self, name: str, factor: float, segment: int | None = None) -> Limb:
        """Return the limb with a parameter of one segment, or of all, times a factor.

        Both models get it, where the calibration gave the arcs numbers of their own.
        """
        changed: dict[str, Any] = {
            key: tuple(
                dataclasses.replace(each, **{name: factor * getattr(each, name)})
                if segment in (None, place)
                else each
                for place, each in enumerate(getattr(self, key))
            )
            for key in ("segments", "pcc_segments")
        }
        return dataclasses.replace(self, **changed)

    def carrying(self, payload: float, at: float | None = None, name: str = PAYLOAD) -> Limb:
        """Return the limb with one more mass.

        Args:
            payload: [kg]; with 0 the limb is returned as it is.
            at: arc length from the clamp [m]; None: the tip. Up to 5 mm beyond the tip is the tip,
                since a calibrated length differs from the measured one.
            name: of the mass.

        Raises:
            LimbError: a negative mass, one far beyond what the limb weighs itself, or a place that
                is not on the limb.
        """
        if payload == 0:
            return self
        if not payload > 0:
            raise LimbError(f"the {name} must be at least 0 kg, got {payload:g}")
        if payload > MOST_CARRIED * self.mass:
            raise LimbError(
                f"the {name} of {payload:g} kg is {payload / self.mass:.0f} times the limb's mass: "
                "give kg"
            )
        place = self.length if at is None else float(at)
        if 0 < place - self.length <= BEYOND_THE_TIP:
            place = self.length
        if not place >= 0:
            raise LimbError(f"the {name}'s arc_length must be at least 0 m, got {place}")
        self._check_place(f"the {name}'s arc_length", place)
        mass = PointMass(place, float(payload), name)
        return dataclasses.replace(self, masses=(*self.masses, mass))

    def loaded(self, load: Load) -> Limb:
        """Return the limb under a load, as `mounted` and `carrying` say.

        Raises:
            LimbError: the mounting is unknown, or the payload is too heavy or not on the limb.
        """
        mounted = self.mounted(load.mounting) if load.mounting else self
        return mounted.carrying(load.payload, load.payload_at or None)

    @property
    def payload(self) -> tuple[float, float]:
        """What only this run carries: its mass [kg], and where along the limb [m]; 0 is the tip."""
        for item in reversed(self.masses):  # `carrying` puts it last
            if item.name == PAYLOAD:
                at_tip = item.arc_length >= self.length * (1 - 1e-9)
                return item.mass, 0.0 if at_tip else item.arc_length
        return 0.0, 0.0

    def mounted(self, mounting: str) -> Limb:
        """Return the limb with the gravity of a mounting, see `gravity_of`.

        A limb that was calibrated or declared under another gravity remembers it, see
        `other_mounting`.
        """
        gravity, known = gravity_of(mounting), self.calibrated
        declared = bool(known.differential_pressure) or any(self.gravity)
        if declared and not known.gravity and mounting_of(gravity) != mounting_of(self.gravity):
            known = dataclasses.replace(known, gravity=self.gravity)
        return dataclasses.replace(self, gravity=gravity, calibrated=known)

    @property
    def other_mounting(self) -> str:
        """A sentence where the limb's numbers are those of another mounting; else empty."""
        before = self.calibrated.gravity
        if not before or mounting_of(before) == mounting_of(self.gravity):
            return ""
        was, now = mounting_of(before), mounting_of(self.gravity)
        if not self.calibrated.differential_pressure:
            return f"the mounting is {now}, the limb was declared as {was}: {now} is taken"
        return (
            f"the mounting is {now}, the limb was calibrated as {was}: the stiffness, gains and "
            f"rest angles that were found as {was} are kept. Calibrate it as {now} if it misses"
        )

    @classmethod
    def from_yaml(cls, path: str | Path) -> Limb:
        """Read a limb file.

        Raises:
            LimbError: the file is missing, is not YAML, or a key is missing, unknown, of the wrong
                type or out of range; the message names the file and the key.
        """
        content = read_yaml(path, "limb file", LimbError)
        try:
            return cls.from_mapping(content)
        except (LimbError, TypeError, ValueError) as error:
            raise LimbError(f"limb file {path}: {error}") from error

    @classmethod
    @functools.cache
    def default(cls) -> Limb:
        """Return the limb that comes with the package: two silicone segments of 0.122 m."""
        return cls.from_yaml(DEFAULT_LIMB_FILE)

    @classmethod
    def from_mapping(cls, content: object) -> Limb:
        """Build a limb from the parsed content of a limb file.

        Raises:
            LimbError: as `from_yaml`, without the file's name.
        """
        if not isinstance(content, Mapping):
            raise LimbError(f"expected a mapping of keys, got {type(content).__name__}")
        body = {"name": "limb", **content}
        version = body.pop("schema_version", None)
        if version != SCHEMA_VERSION:
            raise LimbError(f"schema_version is {version!r}: this program reads {SCHEMA_VERSION}")
        limb: Limb = read(cls, body)
        limb._check_units()
        return limb

    def to_mapping(self) -> dict[str, Any]:
        """Return the content of a limb file, which `from_mapping` makes an equal limb of."""
        return {"schema_version": SCHEMA_VERSION, **dataclasses.asdict(self)}

    def to_yaml(self, path: str | Path) -> None:
        """Write a limb file that `from_yaml` reads back as an equal limb, whole or not at all."""
        text = yaml_text(self.to_mapping(), allow_unicode=True, width=math.inf)
        head = "# A limb, in SI units. How to choose each: the site, python3 scripts/docs.py\n"
        write_whole(path, head + commented(text, Limb))
