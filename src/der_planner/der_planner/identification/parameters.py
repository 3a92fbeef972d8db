"""The unknowns of a fit: names, units, bounds, prior knowledge, place in a limb."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from der_planner.limb import Limb, Parameter, Segment, Term, declarations

Array = NDArray[np.float64]


GROUPS = ("asymmetry", "stiffening", "cubic", "coupling", "friction", "creep", "dynamics")
"""Model terms that may be left out, in the order in which they are explained."""
OPTIONAL = ("mass",)
"""Model terms that are fitted only on request: the mass, in place of the stiffness. A log without
measured forces shows only ratios of stiffness, gain and mass, so one of them must be given."""
_ORDER = ("linear", *GROUPS, *OPTIONAL)
_FITTED: dict[str, Parameter] = {
    key: declared for key, declared in declarations(Segment).items() if declared.fit
}
TERMS: tuple[Term, ...] = tuple(
    sorted(
        (declared.fit for declared in _FITTED.values() if declared.fit),
        key=lambda term: (_ORDER.index(term.group), term.relative),
    )
)
"""Unknowns of each segment, as the fields of `Segment` declare them, by group. Damping by the air
and the plate is one number for the limb: it cannot be told apart by segments.
"""
_INDEX = {term.name: index for index, term in enumerate(TERMS)}
_FIELD = {declared.fit.name: key for key, declared in _FITTED.items() if declared.fit}


def start_values(limb: Limb) -> Array:
    """Return the (M, T) values of a limb, with plausible friction and creep where it has none."""
    values = np.array([[_start(segment, term) for term in TERMS] for segment in limb.segments])
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


def _start(segment: Segment, term: Term) -> float:
    if term.relative:
        return 0.0
    value, divisor = float(getattr(segment, _FIELD[term.name])), 1.0
    for other, power in term.per.items():
        if power > 0:
            value *= getattr(segment, other) ** power
        else:
            divisor *= getattr(segment, other) ** -power
    return value / divisor or term.start


def _segment(prior: Segment, value: dict[str, float]) -> Segment:
    # In the order of declaration, since a term's unit takes parameters that were declared before.
    found: dict[str, float] = dataclasses.asdict(prior)
    for key, declared in _FITTED.items():
        assert declared.fit is not None
        found[key] = _parameter(declared.fit, value[declared.fit.name], found[key], found)
        if declared.needs and not found[declared.needs]:
            found[key] = 0.0
    return Segment(**found)


def _parameter(term: Term, value: float, prior: float, found: dict[str, float]) -> float:
    """Return the parameter that a term's value stands for, in the parameter's unit."""
    if term.relative:
        return float(prior * math.exp(value))
    for other, power in term.per.items():
        if power < 0:
            value *= found[other] ** -power
    for other, power in term.per.items():
        if power > 0:
            value /= found[other] ** power
    return float(value)


def exists(segment: int, term: int, segment_count: int) -> bool:
    """Return whether a segment has a term: the neighbour that it asks for, a shared one once."""
    if TERMS[term].shared:
        return segment == 0
    return 0 <= segment + TERMS[term].neighbour < segment_count


def column(name: str) -> int:
    """Return the place of a term in `TERMS`."""
    return _INDEX[name]


def without(values: Array, groups: frozenset[str]) -> Array:
    """Return the values with the terms outside ``groups`` switched off."""
    result = values.copy()
    for index, term in enumerate(TERMS):
        if term.group in groups or term.group == "linear":
            continue
        keeps = term.kept or _FITTED[_FIELD[term.name]].needs
        if term.relative or not keeps:
            result[:, index] = 0.0
    return result


def put(values: Array, segment: int, term: int, value: float) -> None:
    """Write one unknown, of all segments where it is shared."""
    if TERMS[term].shared:
        values[:, term] = value
    else:
        values[segment, term] = value
