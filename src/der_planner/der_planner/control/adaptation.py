"""Gain and rest angle of a limb, roughly, from the tip of one run.

Learning plans with the model's answer to a change of commands. Where the limb is far from its file,
of another day or another limb altogether, that answer is wrong as well, and a step by it may make
things worse. What the tip tells of gain and rest angle of each segment is then put into the model
first:

    minimise  Σ |measured − model tip|² / (e² ℓ)  +  Σ x²

with x an unknown's distance from the limb file in the spreads of a day, and e² ℓ what the model
leaves anyhow, over as many setpoints as it stays alike. The limb file itself is not touched:
`check_limb.py --update` does that from bend angles and measured pressures, which tell more.
"""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from der_planner.limb import Limb, LimbError, Segment
from der_planner.limb.days import LARGEST_CHANGES, on_another_day
from der_planner.planning.correction import Correction
from der_planner.planning.errors import PlanningError

Array = NDArray[np.float64]

FAR = 3e-3
"""Mean distance [m] between measured and expected tip beyond which a model is adapted."""
_ERROR = 2e-3
"""What the model leaves anyhow [m] …"""
_ALIKE = 20.0
"""… and over how many setpoints it stays alike."""
_STEP = 1e-3
"""Of an unknown in its spread, for a difference of two simulations."""
_BETTER = 0.7
"""Share of the distance that an adapted model may leave to be used."""
_EVALUATIONS = 12
_UNFOLLOWED = 1.0
"""Distance that stands for a rod that cannot be simulated [m]."""


def adapted(correction: Correction, commands: Array, tip: Array) -> Correction | None:
    """Return a model with gains and rest angles under which its tip comes nearest to a run's.

    Args:
        correction: model of the plan.
        commands: (K, M) that were in force [Pa].
        tip: (K, 2) measured, NaN where it was not seen [m].

    Returns:
        None where the model is near the run already, or nothing much is gained.
    """
    seen = np.isfinite(tip).all(axis=1)
    limb = correction.limb
    size = 2 * limb.segment_count

    # Each simulation is asked for by errors, slopes and comparisons at the same unknowns.
    @functools.cache
    def missed_at(key: bytes) -> Array:
        try:
            model = correction.of(moved(limb, np.frombuffer(key)))
            gap = model.expected(commands).tip[seen] - tip[seen]
        except (PlanningError, LimbError):
            gap = np.full((int(seen.sum()), 2), np.nan)
        return np.where(np.isfinite(gap), gap, _UNFOLLOWED)

    def missed(x: Array) -> Array:
        return missed_at(x.tobytes())

    def residual(x: Array) -> Array:
        return np.concatenate([missed(x).ravel() / (_ERROR * np.sqrt(_ALIKE)), x])

    def jacobian(x: Array) -> Array:
        here = residual(x)
        return np.stack([(residual(x + step) - here) / _STEP for step in _STEP * np.eye(size)], 1)

    def far(x: Array) -> float:
        return float(np.linalg.norm(missed(x), axis=1).mean())

    before = far(np.zeros(size))
    if before < FAR:
        return None
    bound = np.tile(LARGEST_CHANGES, limb.segment_count)
    found = least_squares(
        residual,
        np.zeros(size),
        jac=jacobian,
        bounds=(-bound, bound),
        max_nfev=_EVALUATIONS,
        xtol=1e-3,
        ftol=1e-3,
    )
    return correction.of(moved(limb, found.x)) if far(found.x) < _BETTER * before else None


def moved(limb: Limb, x: Array) -> Limb:
    """Return a limb, its arcs too, with the logarithm of gains and the rest angles moved.

    Args:
        limb: to begin with.
        x: (2 M,) gain and rest angle of each segment, in the spreads of a day.
    """

    def each(segments: tuple[Segment, ...]) -> tuple[Segment, ...]:
        return tuple(
            on_another_day(segment, gain, rest)
            for segment, (gain, rest) in zip(segments, x.reshape(-1, 2), strict=True)
        )

    arcs = each(limb.pcc_segments) if limb.pcc_segments else ()
    return replace(limb, segments=each(limb.segments), pcc_segments=arcs)
