"""What a log tells of each unknown of a fit, what it leaves as it was, and what would tell it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.identification.bends import BendFit
from der_planner.identification.report import Unknown, readable
from der_planner.identification.terms import EXPERIMENTS, FreeTerms, terms_of
from der_planner.limb import Term

Mask = NDArray[np.bool_]

UNTOLD = 0.8
"""If the fit leaves an unknown more than this share of its prior deviation, the log does not tell
it."""
STIFFNESS_ERROR = 0.08
"""Least deviation of the logarithm of a stiffness: no model's friction is that of the limb."""
ANOTHER_STIFFNESS = 3.0, math.log(1.5)
"""Differences of the logarithm of a stiffness by a known weight from that by motion beyond which
one of them is wrong: over their standard deviation, and as it is. Both must be passed."""


def untold_stiffness(free: FreeTerms, unknowns: Sequence[Unknown]) -> tuple[Mask, str]:
    """Return which unknowns (P,) keep what was known before the log, and the sentence for it.

    Stiffness that the log does not tell takes up what the model lacks in friction and creep. Where
    it tells that of no segment, it does not tell the damping either.
    """
    stiff = np.array([term.name == "log_stiffness" for term in free.terms], dtype=bool)
    untold = stiff & np.array([unknown.untold for unknown in unknowns], dtype=bool)
    if not untold.any():
        return untold, ""
    if np.array_equal(untold, stiff):
        return np.array([term.group == "dynamics" for term in free.terms]), (
            "the log is too slow to tell the stiffness apart from the gain: stiffness and damping "
            "keep their old values; steps, a sweep or a known weight (--weight) would tell them"
        )
    segments = [str(segment) for (segment, _), out in zip(free.places, untold, strict=True) if out]
    return untold, (
        f"the log hardly tells the stiffness of segment {' and '.join(segments)}: it stays as it "
        f"was known before; {EXPERIMENTS['dynamics']} would tell it"
    )


def against_motion(unknowns: Sequence[Unknown], weighed: Array, doubt: Array) -> Iterator[str]:
    """Yield a sentence for each segment of which a known weight and motion tell another stiffness.

    Args:
        unknowns: of a fit that does not know of the weight.
        weighed: (M,) logarithms of the stiffness by the weight.
        doubt: (M,) their standard deviations; infinite: the weight does not tell it.
    """
    moved = [each for each in unknowns if each.name.startswith("log_stiffness")]
    deviations, least = ANOTHER_STIFFNESS
    for each, value, error in zip(moved, weighed, doubt, strict=False):
        apart = float(value) - each.value
        if not each.untold and abs(apart) > max(
            deviations * math.hypot(each.deviation, error), least
        ):
            yield (
                f"by the weight {each.name.removeprefix('log_')} is {math.exp(apart):.2f} times "
                "what the limb's motion tells: check the weight's mass (--weight) and place "
                "(--at), and that nothing else touched the limb. If they are right, friction "
                "misled the motion, more so in a quick run, and the weight is to be believed"
            )


def kept_unknowns(free: FreeTerms) -> Iterator[Unknown]:
    """Yield terms that the fit left as they were known before, with the deviation of that."""
    before = free.at_places(free.values)
    for term, (segment, _), value in zip(free.terms, free.places, before, strict=True):
        yield Unknown(_name(term, segment), term.unit, float(value), term.spread, untold=True)


def at_bounds(free: FreeTerms, values: Array) -> Iterator[str]:
    """Yield a sentence for each unknown at the end of its range, but for a term that is zero."""
    ends = free.unknowns.at_bound(values)
    for term, (segment, _), value, at_end in zip(
        free.terms, free.places, values, ends, strict=True
    ):
        absent = term.low == 0.0 and value < 0.5 * term.high
        if at_end and not absent:
            factor, unit = readable(term.unit)
            size = math.exp(value) if term.relative else factor * value
            yield (
                f"{_name(term, segment)} is at the end of its range, {size:.3g} "
                f"{'times what was known' if term.relative else unit}, so that others may be "
                f"wrong as well: {EXPERIMENTS[term.group]} would tell it"
            )


def _name(term: Term, segment: int) -> str:
    return term.name if term.shared else f"{term.name}[{segment}]"


def measured_stiffness(problem: BendFit, values: Array) -> tuple[float, ...]:
    """Return the stiffness of the segments by what measured it, else by the fit [N·m²].

    A fit takes some friction and creep for stiffness, which its plans need and a force does not.

    Args:
        problem: that was solved.
        values: (P,) found.
    """
    free = problem.free
    best = free.limb_with(np.where(free.measured, free.unknowns.prior, values))
    return tuple(segment.bending_stiffness for segment in best.segments)


def told(problem: BendFit, values: Array) -> tuple[tuple[Unknown, ...], Array]:
    """Return the unknowns with standard deviations, and their correlation (P, P).

    Args:
        problem: that was solved.
        values: (P,) found.
    """
    free = problem.free
    problem.weigh(problem.errors_left(values))
    covariance = problem.search.covariance(values)
    deviation = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(deviation, deviation)
    at_bound, before = free.unknowns.at_bound(values), terms_of(free.limb)
    stiff = [term.name == "log_stiffness" for term in free.terms]
    spread = np.array([before[place].spread for _, place in free.places])
    # Friction and creep of slow motion tell another stiffness than swings or a weight do.
    apart = np.where(free.measured, np.abs(values - free.unknowns.prior), 0.0)
    least = np.where(stiff, np.maximum(apart, STIFFNESS_ERROR), 0.0)
    unknowns = tuple(
        Unknown(
            name=_name(term, segment),
            unit=term.unit,
            value=float(value),
            deviation=float(sigma),
            untold=bool(out),
            at_bound=bool(edge),
        )
        for term, (segment, _), value, sigma, out, edge in zip(
            free.terms,
            free.places,
            values,
            np.maximum(deviation, least),
            deviation > UNTOLD * spread,
            at_bound,
            strict=True,
        )
    )
    return unknowns, correlation
