"""What a fit may change: parameters of segments, in units that angles and pressures tell."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.identification.least_squares import Unknowns
from der_planner.limb import Limb, Segment, Term, declarations

EXPERIMENTS = {
    "linear": "slow pressures both ways on each segment, in the units of the log,",
    "asymmetry": "slow pressures both ways on each segment",
    "stiffening": "slow pressures up to the limit",
    "cubic": "slow pressures up to the limit",
    "coupling": "pressures on each segment alone",
    "friction": "slow strokes of a few degrees, there and back,",
    "creep": "pressures that are held for a minute",
    "dynamics": "swings while all segments bend on in one direction, or a weight (--weight),",
    "mass": "a scale (--mass)",
}
"""Groups of model terms in the order in which they are explained; what tells each where a log does
not, as the subject of a sentence."""
OPTIONAL = ("mass",)
"""Model terms that are fitted only on request: the mass, in place of the stiffness. A log without
measured forces shows only ratios of stiffness, gain and mass, so one of them must be given."""
GROUPS = tuple(name for name in EXPERIMENTS if name not in ("linear", *OPTIONAL))
"""Model terms that may be left out."""
_DECLARED = {key: item for key, item in declarations(Segment).items() if item.fit}
_FIELDS = {item.fit.name: key for key, item in _DECLARED.items() if item.fit}
TERMS: tuple[Term, ...] = tuple(
    sorted(
        (item.fit for item in _DECLARED.values() if item.fit),
        key=lambda term: (list(EXPERIMENTS).index(term.group), term.relative),
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
        terms: (P,) the free terms, with what is known of them.
    """

    limb: Limb
    values: Array
    places: tuple[tuple[int, int], ...]
    terms: tuple[Term, ...]

    @staticmethod
    def of(limb: Limb, names: Collection[str], values: Array | None = None) -> FreeTerms:
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
        of_limb = terms_of(limb)
        terms = tuple(of_limb[index] for _, index in places)
        return FreeTerms(limb, values_of(limb) if values is None else values, places, terms)

    @property
    def unknowns(self) -> Unknowns:
        """What is known of the free terms."""
        known = [(term.spread, term.low, term.high, term.scale) for term in self.terms]
        return Unknowns(self.at_places(self.values), *np.reshape(known, (-1, 4)).T)

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which terms (P,) something else than the log has measured, see `told`."""
        before = terms_of(self.limb)
        known = [before[column].spread for _, column in self.places]
        return np.asarray(self.unknowns.spread < np.array(known))

    def only(self, chosen: NDArray[np.bool_]) -> FreeTerms:
        """Return those of the terms that are chosen (P,)."""
        places, terms = compress(self.places, chosen), compress(self.terms, chosen)
        return replace(self, places=tuple(places), terms=tuple(terms))

    def told(self, name: str, value: Array, deviation: Array) -> FreeTerms:
        """Return the terms where something else than the log has measured one of each segment.

        Args:
            name: of the term.
            value: (M,) measured.
            deviation: (M,) standard deviation of it; what was known before counts by its own.
        """
        values, terms, column = self.values.copy(), list(self.terms), COLUMN[name]
        for index, (segment, place) in enumerate(self.places):
            if place != column:
                continue
            spread = terms[index].spread
            share = 1.0 / (1.0 + (deviation[segment] / spread) ** 2)
            values[segment, column] += share * (value[segment] - values[segment, column])
            terms[index] = replace(terms[index], spread=spread * math.sqrt(1.0 - share))
        return replace(self, values=values, terms=tuple(terms))

    def at_places(self, table: Array) -> Array:
        """Return the values (P,) of the free terms in a table (M, T)."""
        return np.array([table[place] for place in self.places])

    def limb_with(self, free: Array) -> Limb:
        """Return the limb with values (P,) of the free terms put in place."""
        values = self.values.copy()
        for (segment, index), value in zip(self.places, free, strict=True):
            values[slice(None) if TERMS[index].shared else segment, index] = value
        return to_limb(self.limb, values)


def terms_of(limb: Limb) -> tuple[Term, ...]:
    """Return `TERMS` for a limb of this pressure limit."""
    return tuple(term.at_limit(limb.pneumatics.pressure_limit) for term in TERMS)


def values_of(limb: Limb, *, starts: bool = False) -> Array:
    """Return the (M, T) values of a limb.

    Args:
        limb: to describe.
        starts: put plausible friction and creep where it has none, for a search to begin at.
    """
    terms = terms_of(limb)
    return np.array(
        [[_value(segment, term, starts) for term in terms] for segment in limb.segments]
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
        keeps = term.kept or _DECLARED[_FIELDS[term.name]].needs
        if not keeps and term.group not in ("linear", *groups):
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
        same_unit = all(found[other] == getattr(prior, other) for other in term.per)
        if same_unit and value[term.name] == _value(prior, term, starts=False):
            continue  # so that the number of the limb file stays to the last digit
        if term.relative:
            found[key] *= math.exp(value[term.name])
            continue
        divisor = math.prod(found[other] ** power for other, power in term.per.items())
        found[key] = value[term.name] / divisor
        if declared.needs and not found[declared.needs]:
            found[key] = 0.0
    return Segment(**found)
