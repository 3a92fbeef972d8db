"""Families of planar curves whose heading is linear in the parameters, and their derivatives."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

PLACE = 3
"""Numbers of a planar pose: x, y [m], heading [rad]."""


class Curve:
    """A family of curves: heading linear in the parameters, evaluated at fixed arc lengths.

    Parameters are x0, y0, θ0, elongation − 1, one curvature a segment, then the corrections. Stiff
    stretches keep their heading.
    """

    def __init__(
        self,
        lengths: Sequence[float],
        degrees: int,
        stiff: Sequence[tuple[float, float]] = (),
        grid: int = 6,
    ) -> None:
        ends = np.concatenate([[0.0], np.cumsum(lengths)])
        self.ends = ends
        self.segments = len(lengths)
        self.degrees = degrees
        self.size = 4 + self.segments * (1 + degrees)
        nodes, weights = np.polynomial.legendre.leggauss(4)
        self._stiff = tuple(stiff)
        self.active = np.diff(self._bending_length(ends))
        edges = np.unique(
            np.concatenate(
                [np.linspace(a, b, grid + 1) for a, b in itertools.pairwise(ends)]
                + [np.array(stretch) for stretch in self._stiff]
            )
        )
        self._edges = edges
        self._nodes = nodes
        self._weights = weights

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
            for degree in range(1, self.degrees + 1):
                column = 4 + self.segments + j * self.degrees + degree - 1
                # Integral of the Legendre polynomial from -1.
                series = np.zeros(degree + 1)
                series[degree] = 1.0
                integral = np.polynomial.legendre.legint(series, lbnd=-1.0)
                basis[:, column] = half * np.polynomial.legendre.legval(local, integral)
        return basis

    def quadrature(self, s: Sequence[float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return Gauss points of the limb and weights (n, points) that integrate up to each s."""
        edges = np.unique(np.concatenate([self._edges, np.clip(s, 0.0, self.ends[-1])]))
        middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
        points = (middle[:, None] + half[:, None] * self._nodes).ravel()
        weights = (half[:, None] * self._weights).ravel()
        table = np.where(points[None, :] < np.asarray(s)[:, None], weights, 0.0)
        return points, table


@njit(cache=True)
def wrap(angle: float) -> float:
    """Return an angle between −π and π."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@njit(cache=True)
def write_places(
    parameters: NDArray[np.float64],
    integral: NDArray[np.float64],
    inner: NDArray[np.float64],
    outer: NDArray[np.float64],
    places: NDArray[np.float64],
    slopes: NDArray[np.float64],
) -> None:
    """Write places x, y, heading (n, 3) of a curve and their derivatives (n, 3, size).

    Args:
        parameters: (size,) of the curve.
        integral: (n, points) weights that integrate from the base up to each place.
        inner: (points, size) derivatives of the heading at the points of the integral.
        outer: (n, size) the same at the places.
        places: output.
        slopes: output.
    """
    count, size = outer.shape
    heading = inner @ parameters
    cosine, sine = np.cos(heading), np.sin(heading)
    stretch = 1.0 + parameters[3]
    slopes[:] = 0.0
    for i in range(count):
        x, y = 0.0, 0.0
        for p in range(inner.shape[0]):
            weight = integral[i, p]
            if weight == 0.0:
                continue
            along, across = weight * cosine[p], weight * sine[p]
            x += along
            y += across
            for q in range(2, size):
                slopes[i, 0, q] -= across * inner[p, q]
                slopes[i, 1, q] += along * inner[p, q]
        places[i, 0] = parameters[0] + stretch * x
        places[i, 1] = parameters[1] + stretch * y
        places[i, 2] = 0.0
        for q in range(size):
            slopes[i, 0, q] *= stretch
            slopes[i, 1, q] *= stretch
            slopes[i, 2, q] = outer[i, q]
            places[i, 2] += outer[i, q] * parameters[q]
        slopes[i, 0, 0] = slopes[i, 1, 1] = 1.0
        slopes[i, 0, 3], slopes[i, 1, 3] = x, y


class Evaluation:
    """A curve at a fixed set of arc lengths: places and their derivatives.

    Attributes:
        s: (n,) m, arc lengths.
        integral, inner, outer: tables of `write_places`.
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
        places = np.empty((len(self.s), PLACE))
        slopes = np.empty((len(self.s), PLACE, self.outer.shape[1]))
        write_places(parameters, self.integral, self.inner, self.outer, places, slopes)
        return places, slopes
