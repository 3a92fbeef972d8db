"""The unknowns of a fit: names, units, bounds, prior knowledge, place in a limb."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from der_planner.limb import Limb, Segment

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Term:
    """One unknown of a segment, in units in which it can be told from angles and pressures.

    Attributes:
        name: as reports print it.
        unit: of its value.
        scale: a typical value; the solver works in multiples of it.
        low, high: bounds.
        spread: standard deviation of what is known before any data; infinite for nothing.
        group: the model term that it belongs to; `linear` is always fitted.
        shared: one value for all segments.
        step: of a difference quotient, for what has no exact derivative.
    """

    name: str
    unit: str
    scale: float
    low: float
    high: float
    spread: float
    group: str
    shared: bool = False
    step: float = 0.0


TERMS = (
    Term("gain", "rad/Pa", 5e-5, 5e-6, 5e-4, math.inf, "linear"),
    Term("rest_angle", "rad", 0.02, -0.6, 0.6, math.inf, "linear"),
    Term("gain_asymmetry", "-", 0.03, -0.4, 0.4, 0.1, "asymmetry"),
    Term("pressure_stiffening", "1/Pa", 3e-6, -2e-5, 3e-5, 1e-5, "stiffening"),
    Term("cubic", "1/rad²", 0.05, -0.2, 0.5, 0.05, "cubic"),
    Term("coupling_before", "-", 0.03, -0.4, 0.4, 0.05, "coupling"),
    Term("coupling_after", "-", 0.03, -0.4, 0.4, 0.05, "coupling"),
    Term("friction_pressure", "Pa", 300.0, 0.0, 4000.0, 800.0, "friction"),
    Term("friction_angle", "rad", 0.1, 0.02, 0.8, 0.1, "friction"),
    Term("creep_pressure", "Pa/rad", 500.0, 0.0, 15000.0, 2000.0, "creep"),
    Term("creep_time", "s", 15.0, 3.0, 120.0, 15.0, "creep"),
    Term("material_damping", "s", 0.01, 0.0, 0.1, 0.02, "dynamics", step=2e-3),
    Term("log_stiffness", "-", 0.2, -1.2, 1.2, 0.3, "dynamics", step=0.02),
    Term("log_damping", "-", 0.5, -3.0, 3.0, 0.5, "dynamics", shared=True, step=0.1),
)
"""Unknowns of each segment. The last two are relative to the prior's, as natural logarithms.
Damping by the air and the plate is one number for the limb: it cannot be told apart by segments.
"""

GROUPS = ("asymmetry", "stiffening", "cubic", "coupling", "friction", "creep", "dynamics")
"""Model terms that may be left out, in the order in which they are explained."""
_INDEX = {term.name: index for index, term in enumerate(TERMS)}


def start_values(limb: Limb) -> Array:
    """Return the (M, T) values of a limb, with plausible memory where it has none."""
    rows = []
    for segment in limb.segments:
        gain = segment.moment_gain
        rows.append(
            [
                gain * segment.length / segment.bending_stiffness,
                segment.rest_curvature * segment.length,
                segment.gain_asymmetry,
                segment.pressure_stiffening,
                segment.cubic_stiffness / (segment.bending_stiffness * segment.length**2),
                segment.coupling_before,
                segment.coupling_after,
                segment.friction_moment / gain or 200.0,
                segment.friction_curvature * segment.length or 0.1,
                segment.creep_stiffness / (gain * segment.length) or 400.0,
                segment.creep_time or 15.0,
                segment.material_damping,
                0.0,
                0.0,
            ]
        )
    values = np.array(rows)
    low, high = (np.array([getattr(term, name) for term in TERMS]) for name in ("low", "high"))
    clipped: Array = np.clip(values, low, high)
    return clipped


def to_limb(prior: Limb, values: Array) -> Limb:
    """Return the prior with the unknowns (M, T) put in place."""
    segments = [
        _segment(segment, dict(zip(_INDEX, row, strict=True)))
        for segment, row in zip(prior.segments, values, strict=True)
    ]
    return replace(prior, segments=tuple(segments))


def _segment(prior: Segment, value: dict[str, float]) -> Segment:
    stiffness = prior.bending_stiffness * math.exp(value["log_stiffness"])
    gain = value["gain"] * stiffness / prior.length
    friction, creep = value["friction_pressure"] * gain, value["creep_pressure"] * gain
    return replace(
        prior,
        bending_stiffness=float(stiffness),
        moment_gain=float(gain),
        damping=float(prior.damping * math.exp(value["log_damping"])),
        material_damping=float(value["material_damping"]),
        rest_curvature=float(value["rest_angle"] / prior.length),
        gain_asymmetry=float(value["gain_asymmetry"]),
        pressure_stiffening=float(value["pressure_stiffening"]),
        cubic_stiffness=float(value["cubic"] * stiffness * prior.length**2),
        coupling_before=float(value["coupling_before"]),
        coupling_after=float(value["coupling_after"]),
        friction_moment=float(friction),
        friction_curvature=float(value["friction_angle"] / prior.length) if friction else 0.0,
        creep_stiffness=float(creep * prior.length),
        creep_time=float(value["creep_time"]) if creep else 0.0,
    )


def exists(segment: int, term: int, segment_count: int) -> bool:
    """Return whether a segment has a term: the neighbour that it asks for, a shared one once."""
    if TERMS[term].shared:
        return segment == 0
    if TERMS[term].name == "coupling_before":
        return segment > 0
    return TERMS[term].name != "coupling_after" or segment < segment_count - 1


def column(name: str) -> int:
    """Return the place of a term in `TERMS`."""
    return _INDEX[name]


def without(values: Array, groups: frozenset[str]) -> Array:
    """Return the values with the terms outside ``groups`` switched off."""
    result = values.copy()
    for name, group in (
        ("gain_asymmetry", "asymmetry"),
        ("pressure_stiffening", "stiffening"),
        ("cubic", "cubic"),
        ("coupling_before", "coupling"),
        ("coupling_after", "coupling"),
        ("friction_pressure", "friction"),
        ("creep_pressure", "creep"),
        ("log_stiffness", "dynamics"),
        ("log_damping", "dynamics"),
    ):
        if group not in groups:
            result[:, column(name)] = 0.0
    return result


def put(values: Array, segment: int, term: int, value: float) -> None:
    """Write one unknown, of all segments where it is shared."""
    if TERMS[term].shared:
        values[:, term] = value
    else:
        values[segment, term] = value
