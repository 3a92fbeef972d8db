"""Nonlinear least squares with priors, bounds and standard deviations: every fit of this package.

    minimise  Σ ρ(r(p)²)  +  Σ ρ(((p − p₀) / s)²)      within bounds

with r the weighted residuals of the data, p₀ and s what is known of the unknowns before any data,
and ρ the square itself or, with ``softness``, a loss that grows like a straight line beyond it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from threadpoolctl import ThreadpoolController

from der_planner.arrays import Array

_THREADS = ThreadpoolController()

Rows = tuple[Array, Callable[[], Array]]
"""Weighted residuals (R,) and what gives their derivatives by the unknowns (R, P).

A search asks for derivatives only where a step has led to something better."""

TOLERANCE = 1e-3
"""Relative change of the sum of squares at which a search ends: its unknowns then change by less
than their uncertainty."""
MOST_EVALUATIONS = 25
"""Largest number of evaluations of a search that is not cheap."""


@dataclass(frozen=True)
class Unknowns:
    """P numbers that a fit may change.

    Attributes:
        prior: (P,) most likely values before any data.
        spread: (P,) their standard deviations; infinite where nothing is known.
        low, high: (P,) bounds.
        scale: (P,) typical sizes, in multiples of which the search works.
    """

    prior: Array
    spread: Array
    low: Array
    high: Array
    scale: Array

    @property
    def known(self) -> NDArray[np.bool_]:
        """(P,) whether anything is known before the data."""
        return np.isfinite(self.spread)

    def inside(self, values: Array) -> Array:
        """Return the values (P,), those at a bound moved a little inside."""
        margin = 1e-6 * (self.high - self.low)
        return np.clip(values, self.low + margin, self.high - margin)

    def at_bound(self, values: Array) -> NDArray[np.bool_]:
        """Return (P,) which values sit at a bound of their range."""
        near = np.minimum(values - self.low, self.high - values)
        return np.asarray(near < 1e-3 * (self.high - self.low))


@dataclass(frozen=True)
class LeastSquares:
    """One fit.

    Attributes:
        unknowns: what is free, and what is known of it.
        rows: gives the data's weighted residuals and their derivatives; None for values that the
            model cannot follow.
        softness: weighted residual from which on errors count less than their square; None: never.
        cheap: the rows take no time, so that the search goes on to the last digit, in steps as
            large as the unknowns' scales say, not their derivatives, and sees each row.
    """

    unknowns: Unknowns
    rows: Callable[[Array], Rows | None]
    softness: float | None = None
    cheap: bool = False

    def follows(self, values: Array) -> bool:
        """Return whether the model follows with values (P,)."""
        return bool(np.isfinite(self._all_rows(self.unknowns.inside(values))[0]).all())

    def solve(self, start: Array | None = None, tolerance: float = TOLERANCE) -> Array:
        """Return the best values (P,).

        Args:
            start: (P,) that the model follows; None: the prior's values.
            tolerance: relative change of the sum of squares at which the search ends.

        Raises:
            ValueError: the model cannot be followed at the start.
        """
        unknowns = self.unknowns
        begin = unknowns.inside(unknowns.prior if start is None else start)
        rows = self._all_rows if self.cheap else self._summed

        def residual(x: Array) -> Array:
            return rows(x * unknowns.scale)[0]

        def jacobian(x: Array) -> Array:
            return rows(x * unknowns.scale)[1]()

        tolerance *= 1e-4 if self.cheap else 1.0
        # The matrices are too small for more threads, which would wait for each other.
        with _THREADS.limit(limits=1, user_api="blas"):
            solution = least_squares(
                residual,
                begin / unknowns.scale,
                jac=jacobian,
                bounds=(unknowns.low / unknowns.scale, unknowns.high / unknowns.scale),
                loss="soft_l1" if self.cheap and self.softness else "linear",
                f_scale=self.softness or 1.0,
                x_scale=1.0 if self.cheap else "jac",
                xtol=10.0 * tolerance,
                ftol=tolerance,
                max_nfev=10 * MOST_EVALUATIONS if self.cheap else MOST_EVALUATIONS,
            )
        return np.asarray(solution.x * unknowns.scale)

    def _all_rows(self, values: Array) -> Rows:
        """Return the rows of the data and of the prior at values (P,), in the search's scale.

        Rows that the model cannot follow are NaN, which drives the search to a shorter step.
        """
        unknowns, known, found = self.unknowns, self.unknowns.known, self.rows(values)
        residual = np.full(1, np.nan) if found is None else found[0]
        prior = ((values - unknowns.prior) / unknowns.spread)[known]

        def slopes() -> Array:
            data = np.zeros((1, len(values))) if found is None else found[1]() * unknowns.scale
            return np.concatenate([data, np.diag(unknowns.scale / unknowns.spread)[known]])

        return np.concatenate([residual, prior]), slopes

    def _summed(self, values: Array) -> Rows:
        """Return P + 1 rows that stand for all, the loss included.

        All but the last are 0. Their sum of squares is that of all rows under the loss, and so are
        gradient and matrix of Gauss and Newton. The search takes singular values of its rows: of
        thousands that would take longer than a simulation.
        """
        residual, slopes = self._all_rows(values)
        growth, total = np.ones(len(residual)), float(residual @ residual)
        if self.softness is not None:
            growth = np.sqrt(1.0 + (residual / self.softness) ** 2)
            total = 2.0 * self.softness**2 * float(np.sum(growth - 1.0))
        root = math.sqrt(total)

        def summed() -> Array:
            by = slopes()
            weighed = by / growth[:, None]
            last = weighed.T @ residual / max(root, 1e-150)
            squares, ways = np.linalg.eigh(by.T @ weighed - np.outer(last, last))
            return np.vstack([np.sqrt(np.maximum(squares, 0.0))[:, None] * ways.T, last])

        return np.append(np.zeros(len(values)), root), summed

    def covariance(self, values: Array, factor: float = 1.0) -> Array:
        """Return the covariance (P, P) of values that were found.

        Args:
            values: (P,) as found.
            factor: by which the data's variance is larger than their weights say.
        """
        unknowns = self.unknowns
        found = self.rows(values)
        assert found is not None
        slopes = found[1]() * unknowns.scale
        prior = np.where(unknowns.known, unknowns.scale / unknowns.spread, 0.0)
        information = slopes.T @ slopes / max(factor, 1e-6) + np.diag(prior**2)
        covariance = np.linalg.pinv(information, hermitian=True)
        return np.asarray(covariance * np.outer(unknowns.scale, unknowns.scale))


def same_values(values: Array, unknowns: Unknowns) -> bytes:
    """Return a key that values (P,) share with those that differ by rounding alone."""
    return np.round(values / unknowns.scale, 12).tobytes()


def with_differences(residual: Callable[[Array], Array], values: Array, steps: Array) -> Rows:
    """Return residuals (R,) at values (P,); their derivatives are forward differences.

    Args:
        residual: to evaluate.
        values: where.
        steps: (P,) changes of the values, negative for one that must not grow.
    """
    here = residual(values)

    def slopes() -> Array:
        moved = [residual(values + step) for step in np.diag(steps)]
        return np.stack([there - here for there in moved], axis=1) / steps

    return here, slopes


def correlation_length(remaining: Array) -> float:
    """Return over how many rows the errors (K, M) of a prediction stay alike, 1 or more.

    One plus twice the sum of the autocorrelation up to its first zero, at most a third of the log;
    the larger of the columns.
    """
    lengths, longest = [1.0], len(remaining) // 3
    for error in remaining.T:
        known = error[np.isfinite(error)]
        known = known - known.sum() / max(known.size, 1)
        if longest and known.any():
            products = np.correlate(known, known, "full")[known.size - 1 :][:longest]
            end = np.argmax(np.append(products, 0.0) <= 0.0)
            lengths.append(2.0 * float(products[:end].sum() / products[0]) - 1.0)
    return max(lengths)
