"""Planar curves whose heading is linear in their parameters, and the fit of one to places."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

PLACE = 3
"""A planar pose has so many numbers: x, y [m], heading [rad]."""

_PASSES = 12

_SETTLED = 1e-5
"""Steps end when heading [rad] and base [m] change by less than this; its square is left."""

_GRID = 6
"""Intervals of a segment over which the heading is integrated."""


class Curve:
    """A family of curves: heading linear in the parameters, evaluated at fixed arc lengths.

    Parameters are x0, y0, θ0, elongation − 1, one curvature a segment, then the corrections. Stiff
    stretches keep their heading.
    """

    def __init__(
        self, lengths: Sequence[float], degrees: int, stiff: Sequence[tuple[float, float]] = ()
    ) -> None:
        ends = np.concatenate([[0.0], np.cumsum(lengths)])
        self.ends = ends
        self.segments = len(lengths)
        self.degrees = degrees
        self.size = 4 + self.segments * (1 + degrees)
        self._nodes, self._weights = np.polynomial.legendre.leggauss(4)
        self._stiff = tuple(stiff)
        self.active = np.diff(self._bending_length(ends))
        grids = [np.linspace(a, b, _GRID + 1) for a, b in itertools.pairwise(ends)]
        self._edges = np.concatenate([*grids, *self._stiff])

    def _bending_length(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how much of the limb up to each arc length can bend [m]."""
        result = np.clip(s, 0.0, self.ends[-1])
        for start, end in self._stiff:
            result = result - (np.clip(s, start, end) - start)
        return result

    def heading_basis(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return dθ/dp at arc lengths (n,), (n, size)."""
        basis = np.zeros((len(s), self.size))
        basis[:, 2] = 1.0
        bending, starts = self._bending_length(s), self._bending_length(self.ends)
        for j in range(self.segments):
            half = 0.5 * self.active[j]
            local = np.clip((bending - starts[j]) / half - 1.0, -1.0, 1.0)
            basis[:, 4 + j] = half * (local + 1.0)
            # The integral of the Legendre polynomial of degree n from -1 is that of degree n + 1
            # less that of degree n - 1, over 2 n + 1.
            legendre = np.polynomial.legendre.legvander(local, self.degrees + 1)
            first, degrees = 4 + self.segments + j * self.degrees, np.arange(1, self.degrees + 1)
            integrals = (legendre[:, 2:] - legendre[:, :-2]) / (2 * degrees + 1)
            basis[:, first : first + self.degrees] = half * integrals
        return basis

    def quadrature(self, s: Sequence[float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return Gauss points of the limb and weights (n, points) that integrate up to each s."""
        edges = np.unique(np.concatenate([self._edges, np.clip(s, 0.0, self.ends[-1])]))
        middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
        points = (middle[:, None] + half[:, None] * self._nodes).ravel()
        weights = (half[:, None] * self._weights).ravel()
        table = np.where(points[None, :] < np.asarray(s)[:, None], weights, 0.0)
        return points, table


class Evaluation:
    """A curve at a fixed set of arc lengths: places and their derivatives.

    Attributes:
        s: (n,) m, arc lengths.
        integral: (n, points) weights that integrate from the base up to each place.
        inner: (points, size) derivatives of the heading at the points of the integral.
        outer: (n, size) the same at the places.
    """

    def __init__(self, curve: Curve, s: Sequence[float]) -> None:
        self.s = np.asarray(s, dtype=np.float64)
        points, self.integral = curve.quadrature(s)
        self.inner = curve.heading_basis(points)
        self.outer = curve.heading_basis(self.s)

    def places(
        self, parameters: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return x, y, heading (n, 3) and their derivatives (n, 3, size)."""
        heading = self.inner @ parameters
        along, across = self.integral * np.cos(heading), self.integral * np.sin(heading)
        x, y, stretch = along.sum(axis=1), across.sum(axis=1), 1.0 + parameters[3]
        places = np.empty((len(self.s), PLACE))
        places[:, 0], places[:, 1] = parameters[0] + stretch * x, parameters[1] + stretch * y
        places[:, 2] = self.outer @ parameters
        slopes = np.empty((len(self.s), PLACE, len(parameters)))
        slopes[:, 0] = -stretch * (across @ self.inner)
        slopes[:, 1] = stretch * (along @ self.inner)
        slopes[:, 2] = self.outer
        slopes[:, 0, 0] = slopes[:, 1, 1] = 1.0
        slopes[:, 0, 3], slopes[:, 1, 3] = x, y
        return places, slopes


@dataclass(frozen=True)
class CurveFit:
    """The most probable curve through measured places.

    Attributes:
        parameters: (size,) of the curve.
        gain: (size, n, 3) derivative of the parameters by the measurements.
        residuals: (n, 3) measurements less the fit.
        left_open: (size, size) how much of each parameter the measurements leave to the prior, in
            standard deviations of the prior.
    """

    parameters: NDArray[np.float64]
    gain: NDArray[np.float64]
    residuals: NDArray[np.float64]
    left_open: NDArray[np.float64]


def fit_curve(
    evaluation: Evaluation,
    measured: NDArray[np.float64],
    covariances: NDArray[np.float64],
    prior_sigma: NDArray[np.float64],
    start: NDArray[np.float64],
) -> CurveFit:
    """Fit a curve whose heading is linear in its parameters to places (maximum a posteriori).

    Args:
        evaluation: of the curve at the n places.
        measured: (n, 3) x, y [m] and heading [rad].
        covariances: (n, 3, 3) of their errors, which are independent from place to place.
        prior_sigma: (size,) standard deviations of the parameters, about zero.
        start: (size,) parameters to start from.
    """
    parameters, size = start.copy(), len(start)
    whiten = np.linalg.inv(np.linalg.cholesky(covariances))
    weak = np.diag(prior_sigma**-2.0)
    for _ in range(_PASSES):
        places, slopes = evaluation.places(parameters)
        gaps = measured - places
        gaps[:, 2] = (gaps[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
        rows = (whiten @ slopes).reshape(-1, size)
        normal = rows.T @ rows + weak
        right = rows.T @ (whiten @ gaps[:, :, None]).ravel() - weak @ parameters
        move = np.linalg.solve(normal, right)
        # A step of more than a radian of heading is damped: the fit may start far away.
        reach = float(np.abs(evaluation.inner @ move).max())
        parameters += move * min(1.0, 1.0 / max(reach, 1e-9))
        if reach < _SETTLED and np.abs(move[:2]).max() < _SETTLED:
            break
    by_rows = np.linalg.solve(normal, rows.T).reshape(size, -1, 1, PLACE)
    gain = np.asarray((by_rows @ whiten)[:, :, 0], dtype=np.float64)
    left_open = (np.eye(size) - np.tensordot(gain, slopes, 2)) * prior_sigma
    return CurveFit(parameters, gain, gaps, np.asarray(left_open, dtype=np.float64))
