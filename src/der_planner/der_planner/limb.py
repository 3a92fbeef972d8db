"""One robot: every physical parameter of a limb, validated, from and to YAML.

All values are SI. A limb file names the unit of each key, carries a schema version and says where
its numbers come from, so that the nodes of one run and the runs of one lab share a single
description.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

SCHEMA_VERSION = 1
VENT_REFERENCE = 10e3
"""Gauge pressure [Pa] for which `Pneumatics.vent_rate` is given."""
DEFAULT_LIMB_FILE = Path(__file__).resolve().parent / "data" / "default_limb.yaml"


class LimbError(ValueError):
    """A limb description is incomplete or impossible; the message says where and why."""


@dataclass(frozen=True)
class Segment:
    """One actuated segment: a uniform rod with a pair of opposed chambers.

    Attributes:
        length: actuated length [m].
        bending_stiffness: EI [N·m²].
        axial_stiffness: EA [N].
        torsional_stiffness: GJ [N·m²].
        mass_per_length: [kg/m].
        damping: mass-proportional damping coefficient [1/s].
        moment_gain: G, bending moment per differential pressure [N·m/Pa].
        rest_curvature: signed curvature at zero differential pressure [1/m], positive toward +y.
        cubic_stiffness: k3 in moment = EI (κ − κ̄) + k3 (κ − κ̄)³ [N·m⁴]; 0 is a linear segment.
        material_damping: Kelvin-Voigt time τ in moment = EI (κ + τ κ̇) [s].
        gain_asymmetry: relative gain of the left over the mean of both chambers [-].
        pressure_stiffening: relative growth of the stiffness per |differential pressure| [1/Pa].
        friction_moment: saturation of a Dahl friction element [N·m].
        friction_curvature: change of curvature over which friction turns round [1/m].
        creep_stiffness: of a Maxwell element beside EI [N·m²].
        creep_time: relaxation time of it [s].
        coupling_before, coupling_after: moment on this segment by the pressure in the segment
            before and in the one after it, over that of its own pressure [-]: a tube that passes
            through, a wall that is shared.

    The last eight are those of `der_planner.model.material`, which turns the differential pressure
    into the effective one that drives the rod and the PCC model. All zero: the two are the same.
    """

    length: float
    bending_stiffness: float
    axial_stiffness: float
    torsional_stiffness: float
    mass_per_length: float
    damping: float
    moment_gain: float
    rest_curvature: float = 0.0
    cubic_stiffness: float = 0.0
    material_damping: float = 0.0
    gain_asymmetry: float = 0.0
    pressure_stiffening: float = 0.0
    friction_moment: float = 0.0
    friction_curvature: float = 0.0
    creep_stiffness: float = 0.0
    creep_time: float = 0.0
    coupling_before: float = 0.0
    coupling_after: float = 0.0


@dataclass(frozen=True)
class Pneumatics:
    """How a commanded differential pressure becomes a measured one, and what may be asked for.

    Attributes:
        pressure_limit: largest |differential pressure| [Pa].
        slew_limit: largest |change of a commanded differential pressure| per second [Pa/s].
        fill_rate: rate at which a filling chamber ramps [Pa/s].
        time_constant: first-order lag from command to chamber [s].
        delay: dead time from command to the first change in the chamber [s].
        minimum_supply: least absolute supply pressure that the board needs [Pa].
        vent_time_constant: lag while |differential pressure| falls [s]; 0 = as `time_constant`.
        vent_rate: rate at which a chamber at `VENT_REFERENCE` falls with its outlet wide open
            [Pa/s]; 0 = outlets never hold a chamber up.
        vent_exponent: the rate grows with this power of the chamber's gauge pressure [-]: 1/2 is an
            orifice, 1 a tube (one exponential); two thirds were seen on a real limb.
    """

    pressure_limit: float
    slew_limit: float
    fill_rate: float
    time_constant: float
    delay: float = 0.0
    minimum_supply: float = 0.0
    vent_time_constant: float = 0.0
    vent_rate: float = 0.0
    vent_exponent: float = 2.0 / 3.0

    @property
    def vent_lag(self) -> float:
        """First-order lag while |differential pressure| falls [s]."""
        return self.vent_time_constant or self.time_constant


@dataclass(frozen=True)
class CalibratedRange:
    """What a calibration run covered, so that a plan beyond it can be recognised.

    Attributes:
        differential_pressure: (M,) largest |differential pressure| seen [Pa].
        bend_angle: (M,) largest |bend angle| seen [rad].
    """

    differential_pressure: tuple[float, ...] = ()
    bend_angle: tuple[float, ...] = ()


@dataclass(frozen=True)
class Limb:
    """A planar pneumatic limb of M segments in the frame `limb_base`.

    Attributes:
        name: of the robot.
        segments: (M,) from the clamp to the tip.
        pneumatics: of all chamber pairs.
        connector_length: straight passive piece between two segments [m]; 0 lets the rod's mesh
            choose one edge that belongs to neither segment.
        base_length: straight passive piece between the clamp and the first segment [m].
        gravity: acceleration in `limb_base` [m/s²]; the limb lies on its plane by default.
        calibrated: what the numbers were identified on.
        provenance: free text by key: source, date, bag, residuals.
        pcc_segments: (M,) what the same data say of the PCC model, where that differs; empty: as
            `segments`.
    """

    name: str
    segments: tuple[Segment, ...]
    pneumatics: Pneumatics
    connector_length: float = 0.0
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    calibrated: CalibratedRange = field(default_factory=CalibratedRange)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    pcc_segments: tuple[Segment, ...] = ()
    base_length: float = 0.0

    def __post_init__(self) -> None:
        if not self.segments:
            raise LimbError(f"limb '{self.name}' has no segments: give at least one")
        for key in ("segments", "pcc_segments"):
            for index, segment in enumerate(getattr(self, key)):
                where = f"{key}[{index}]"
                _check_numbers(segment, where, may_be_zero=_MAY_BE_ZERO, signed=_SIGNED)
                _check_memory(segment, where)
        if self.pcc_segments and len(self.pcc_segments) != len(self.segments):
            raise LimbError(
                f"pcc_segments has {len(self.pcc_segments)} entries, segments {len(self.segments)}"
            )
        _check_numbers(self.pneumatics, "pneumatics", may_be_zero=_PNEUMATICS_MAY_BE_ZERO)
        if self.pneumatics.vent_exponent > 1.0:
            raise LimbError(
                "pneumatics.vent_exponent must be 1 (a tube) or less, got "
                f"{self.pneumatics.vent_exponent}"
            )
        for key in ("connector_length", "base_length"):
            length = getattr(self, key)
            if not (math.isfinite(length) and length >= 0):
                raise LimbError(f"{key} must be 0 or more m, got {length}")
        if len(self.gravity) != 3 or not all(math.isfinite(value) for value in self.gravity):
            raise LimbError(f"gravity must be three finite numbers in m/s², got {self.gravity}")

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
    def static_gain(self) -> NDArray[np.float64]:
        """(M,) bend angle per differential pressure of a linear segment, G L / EI [rad/Pa]."""
        return np.array([s.moment_gain * s.length / s.bending_stiffness for s in self.segments])

    def for_model(self, model: str) -> Limb:
        """Return the limb as a model sees it: "pcc" with its own segments, if any."""
        if model not in ("der", "pcc"):
            raise LimbError(f"model must be 'der' or 'pcc', got {model!r}")
        if model == "der" or not self.pcc_segments:
            return self
        return dataclasses.replace(self, segments=self.pcc_segments, pcc_segments=())

    @classmethod
    def from_yaml(cls, path: str | Path) -> Limb:
        """Read a limb file.

        Raises:
            LimbError: the file is missing, is not YAML, or a key is missing, unknown, of the wrong
                type or out of range; the message names the file and the key.
        """
        path = Path(path)
        try:
            content = yaml.safe_load(path.read_text())
        except OSError as error:
            raise LimbError(f"cannot read limb file {path}: {error.strerror}") from error
        except yaml.YAMLError as error:
            raise LimbError(f"limb file {path} is not valid YAML: {error}") from error
        try:
            return cls.from_mapping(content)
        except LimbError as error:
            raise LimbError(f"limb file {path}: {error}") from error

    @classmethod
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
        version = content.get("schema_version")
        if version != SCHEMA_VERSION:
            raise LimbError(f"schema_version is {version!r}: this program reads {SCHEMA_VERSION}")
        _refuse_unknown(content, {"schema_version", *_field_names(cls)}, "")
        calibrated = content.get("calibrated") or {}
        return cls(
            name=str(content.get("name", "limb")),
            segments=_segments(content.get("segments"), "segments"),
            pcc_segments=_segments(content.get("pcc_segments") or [], "pcc_segments"),
            pneumatics=_from_mapping(Pneumatics, content.get("pneumatics"), "pneumatics"),
            connector_length=_number(content.get("connector_length", 0.0), "connector_length"),
            base_length=_number(content.get("base_length", 0.0), "base_length"),
            gravity=_triple(content.get("gravity", (0.0, 0.0, 0.0))),
            calibrated=CalibratedRange(
                **{key: tuple(float(v) for v in values) for key, values in calibrated.items()}
            ),
            provenance=dict(content.get("provenance") or {}),
        )

    def to_yaml(self, path: str | Path) -> None:
        """Write a limb file that `from_yaml` reads back as an equal limb."""
        body: dict[str, Any] = {"schema_version": SCHEMA_VERSION, **dataclasses.asdict(self)}
        body["gravity"] = list(self.gravity)
        body["segments"] = list(body["segments"])
        body["pcc_segments"] = list(body["pcc_segments"])
        body["calibrated"] = {key: list(value) for key, value in body["calibrated"].items()}
        body["provenance"] = dict(self.provenance)
        text = yaml.safe_dump(body, sort_keys=False, allow_unicode=True)
        Path(path).write_text(_UNITS + text)


_UNITS = """\
# A limb: every number in SI units.
# length, connector_length, base_length [m]; bending_stiffness EI, torsional_stiffness GJ [N m^2];
# axial_stiffness EA [N]; mass_per_length [kg/m]; damping [1/s]; moment_gain [N m/Pa];
# rest_curvature [1/m]; cubic_stiffness [N m^4]; material_damping [s]; pressure_limit [Pa];
# gain_asymmetry [-]; pressure_stiffening [1/Pa]; friction_moment [N m]; friction_curvature [1/m];
# creep_stiffness [N m^2]; creep_time [s]; coupling_before, coupling_after [-];
# slew_limit, fill_rate [Pa/s]; time_constant, vent_time_constant, delay [s];
# vent_rate [Pa/s, of a chamber at 10 kPa; 0: no limit]; vent_exponent [-];
# minimum_supply [Pa, absolute];
# gravity [m/s^2]; calibrated.differential_pressure [Pa]; calibrated.bend_angle [rad].
"""
_SIGNED = {
    "rest_curvature",
    "cubic_stiffness",
    "gain_asymmetry",
    "pressure_stiffening",
    "coupling_before",
    "coupling_after",
}
_MAY_BE_ZERO = {
    "damping",
    "material_damping",
    "friction_moment",
    "friction_curvature",
    "creep_stiffness",
    "creep_time",
}
_PNEUMATICS_MAY_BE_ZERO = {"delay", "minimum_supply", "vent_time_constant", "vent_rate"}


def _check_memory(segment: Segment, where: str) -> None:
    for strength, scale in (
        ("friction_moment", "friction_curvature"),
        ("creep_stiffness", "creep_time"),
    ):
        if getattr(segment, strength) > 0 and getattr(segment, scale) == 0:
            raise LimbError(f"{where}.{scale} must be positive where {strength} is")
    for name, limit in (("gain_asymmetry", 1.0), ("coupling_before", 0.5), ("coupling_after", 0.5)):
        if not abs(getattr(segment, name)) < limit:
            raise LimbError(
                f"{where}.{name} must be within ±{limit:g}, got {getattr(segment, name)}"
            )


def _segments(content: object, key: str) -> tuple[Segment, ...]:
    if not isinstance(content, Sequence) or isinstance(content, str):
        raise LimbError(f"{key} must be a list with one entry a segment")
    return tuple(
        _from_mapping(Segment, item, f"{key}[{index}]") for index, item in enumerate(content)
    )


def _field_names(kind: Any) -> set[str]:
    return {item.name for item in dataclasses.fields(kind)}


def _refuse_unknown(content: Mapping[str, Any], known: set[str], where: str) -> None:
    unknown = sorted(str(key) for key in content if key not in known)
    if unknown:
        raise LimbError(
            f"unknown key {where}{unknown[0]}: the keys here are {', '.join(sorted(known))}"
        )


def _number(value: object, key: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        hint = " (YAML reads 1e-3 as text: write 1.0e-3)" if isinstance(value, str) else ""
        raise LimbError(f"{key} must be a number, got {value!r}{hint}")
    return float(value)


def _triple(value: object) -> tuple[float, float, float]:
    if not isinstance(value, Sequence) or len(value) != 3:
        raise LimbError(f"gravity must be three numbers in m/s², got {value!r}")
    x, y, z = (_number(item, "gravity") for item in value)
    return x, y, z


def _from_mapping(kind: Any, content: object, where: str) -> Any:
    if not isinstance(content, Mapping):
        raise LimbError(f"{where} must be a mapping of keys, got {content!r}")
    _refuse_unknown(content, _field_names(kind), f"{where}.")
    for item in dataclasses.fields(kind):
        if item.default is dataclasses.MISSING and item.name not in content:
            raise LimbError(f"{where}.{item.name} is missing")
    return kind(**{key: _number(value, f"{where}.{key}") for key, value in content.items()})


def _check_numbers(
    item: Any, where: str, may_be_zero: set[str], signed: set[str] | None = None
) -> None:
    for name, value in dataclasses.asdict(item).items():
        if not math.isfinite(value):
            raise LimbError(f"{where}.{name} must be finite, got {value}")
        if name in (signed or set()):
            continue
        if value < 0 or (value == 0 and name not in may_be_zero):
            least = "0 or more" if name in may_be_zero else "positive"
            raise LimbError(f"{where}.{name} must be {least}, got {value}")
