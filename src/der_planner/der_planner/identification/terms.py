"""The unknowns of a calibration: parameters of segments in units that angles and pressures tell."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from der_planner.arrays import Array
from der_planner.identification.least_squares import Unknowns
from der_planner.limb import Limb, Segment, Term, declarations

GROUPS = ("asymmetry", "stiffening", "cubic", "coupling", "friction", "creep", "dynamics")
"""Model terms that may be left out, in the order in which they are explained."""
OPTIONAL = ("mass",)
"""Model terms that are fitted only on request: the mass, in place of the stiffness. A log without
measured forces shows only ratios of stiffness, gain and mass, so one of them must be given."""
_ORDER = ("linear", *GROUPS, *OPTIONAL)
_DECLARED = {key: item for key, item in declarations(Segment).items() if item.fit}
_FIELDS = {item.fit.name: key for key, item in _DECLARED.items() if item.fit}
TERMS: tuple[Term, ...] = tuple(
    sorted(
        (item.fit for item in _DECLARED.values() if item.fit),
        key=lambda term: (_ORDER.index(term.group), term.relative),
    )
)
"""Terms of each segment, as the fields of `Segment` declare them, by group. Damping by the air and
the plate is one number for the limb: it cannot be told apart by segments."""
COLUMN = {term.name: index for index, term in enumerate(TERMS)}
"""Place of each term in `TERMS` by its name."""


@dataclass(frozen=True)
class FreeTerms:
    """The terms of a limb that a fit may change.

    Attributes:
        limb: with the numbers that are known before.
        values: (M, T) values of all terms.
        places: P pairs of segment and term that are free; a shared term stands in segment 0.
    """

    limb: Limb
    values: Array
    places: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, limb: Limb, names: Collection[str], values: Array | None = None) -> FreeTerms:
        """Return the terms of these names in all segments that have them.

        Args:
            limb: with the numbers that are known before.
            names: of terms.
            values: (M, T) of all terms; None: the limb's.
        """
        places = tuple(
            (segment, index)
            for segment in range(limb.segment_count)
            for index, term in enumerate(TERMS)
            if term.name in names
            and (segment == 0 or not term.shared)
            and 0 <= segment + term.neighbour < limb.segment_count
        )
        return cls(limb, values_of(limb) if values is None else values, places)

    @property
    def terms(self) -> tuple[Term, ...]:
        """(P,) the free terms."""
        return tuple(TERMS[index] for _, index in self.places)

    @property
    def unknowns(self) -> Unknowns:
        """What is known of the free terms."""
        terms = self.terms
        return Unknowns(
            prior=self.at_places(self.values),
            spread=np.array([term.spread for term in terms]),
            low=np.array([term.low for term in terms]),
            high=np.array([term.high for term in terms]),
            scale=np.array([term.scale for term in terms]),
        )

    def at_places(self, table: Array) -> Array:
        """Return the values (P,) of the free terms in a table (M, T)."""
        return np.array([table[place] for place in self.places])

    def limb_with(self, free: Array) -> Limb:
        """Return the limb with values (P,) of the free terms put in place."""
        values = self.values.copy()
        for (segment, index), value in zip(self.places, free, strict=True):
            values[slice(None) if TERMS[index].shared else segment, index] = value
        return to_limb(self.limb, values)


def values_of(limb: Limb, *, starts: bool = False) -> Array:
    """Return the (M, T) values of a limb.

    Args:
        limb: to describe.
        starts: put plausible friction and creep where it has none, for a search to begin at.
    """
    return np.array(
        [[_value(segment, term, starts) for term in TERMS] for segment in limb.segments]
    )


def to_limb(prior: Limb, values: Array) -> Limb:
    """Return the prior with the values (M, T) of all terms put in place."""
    segments = (
        _segment(segment, dict(zip(COLUMN, map(float, row), strict=True)))
        for segment, row in zip(prior.segments, values, strict=True)
    )
    return replace(prior, segments=tuple(segments))


def without(values: Array, groups: Collection[str]) -> Array:
    """Return the values (M, T) with the terms outside ``groups`` switched off."""
    result = values.copy()
    for index, term in enumerate(TERMS):
        if term.group in groups or term.group == "linear":
            continue
        keeps = term.kept or _DECLARED[_FIELDS[term.name]].needs
        if term.relative or not keeps:
            result[:, index] = 0.0
    return result


def _value(segment: Segment, term: Term, starts: bool) -> float:
    if term.relative:
        return 0.0
    value = float(getattr(segment, _FIELDS[term.name]))
    for other, power in term.per.items():
        value *= getattr(segment, other) ** power
    return value or (term.start if starts else 0.0)


def _segment(prior: Segment, value: dict[str, float]) -> Segment:
    # In the order of declaration, since a term's unit takes parameters that were declared before.
    found: dict[str, float] = dataclasses.asdict(prior)
    for key, declared in _DECLARED.items():
        term = declared.fit
        assert term is not None
        if term.relative:
            found[key] *= math.exp(value[term.name])
            continue
        divisor = math.prod(found[other] ** power for other, power in term.per.items())
        found[key] = value[term.name] / divisor
        if declared.needs and not found[declared.needs]:
            found[key] = 0.0
    return Segment(**found)
