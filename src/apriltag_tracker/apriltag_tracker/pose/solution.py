"""The most probable curve through measured places, by Gauss-Newton, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from apriltag_tracker.pose.curve import wrap, write_places

_PASSES = 12
_SETTLED = 1e-9
"""Steps end when heading [rad] and base [m] change by less."""


@njit(cache=True)
def _whitening(covariances: NDArray[np.float64], slack: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrices (n, 3, 3) that make the measurements' errors independent and of one."""
    whiten = np.empty_like(covariances)
    for i in range(covariances.shape[0]):
        whiten[i] = np.linalg.inv(np.linalg.cholesky(covariances[i] + np.diag(slack)))
    return whiten


@njit(cache=True)
def _write_gains(
    inverse: NDArray[np.float64],
    by: NDArray[np.float64],
    whiten: NDArray[np.float64],
    slopes: NDArray[np.float64],
    gain: NDArray[np.float64],
    left_open: NDArray[np.float64],
) -> None:
    """Write the derivative G of the parameters by the measurements, and I - G J."""
    left_open[:] = np.eye(len(inverse))
    for i in range(len(by)):
        share = inverse @ np.ascontiguousarray(by[i].T) @ whiten[i]
        gain[:, i] = share
        left_open -= share @ slopes[i]


@njit(cache=True)
def solve_shape(
    measured: NDArray[np.float64],
    covariances: NDArray[np.float64],
    slack: NDArray[np.float64],
    weak: NDArray[np.float64],
    integral: NDArray[np.float64],
    inner: NDArray[np.float64],
    outer: NDArray[np.float64],
    parameters: NDArray[np.float64],
    gain: NDArray[np.float64],
    gap: NDArray[np.float64],
    left_open: NDArray[np.float64],
) -> None:
    """Fit a curve whose heading is linear in its parameters to places (maximum a posteriori).

    Args:
        measured: (n, 3) x, y [m] and heading [rad].
        covariances: (n, 3, 3) of their noise.
        slack: (3,) variances of what they may be off besides.
        weak: (size,) one over the prior's standard deviations; its mean is zero.
        integral: table of `curve.write_places`, as are the next two.
        inner: (points, size).
        outer: (n, size).
        parameters: (size,) where to start from; output, the most probable ones.
        gain: (size, n, 3) output, derivative of the parameters by the measurements.
        gap: (n, 3) output, measurements less the fit.
        left_open: (size, size) output, how much of each parameter the measurements leave to the
            prior, in standard deviations of the prior.
    """
    count, size = outer.shape
    whiten = _whitening(covariances, slack)
    places, slopes = np.empty((count, 3)), np.empty((count, 3, size))
    # Rows count as measurements; `by` are the same turned into noise of one.
    by = np.empty((count, 3, size))
    normal = np.empty((size, size))
    for _ in range(_PASSES):
        write_places(parameters, integral, inner, outer, places, slopes)
        normal[:] = np.diag(weak**2)
        right = -(weak**2) * parameters
        for i in range(count):
            gap[i] = measured[i] - places[i]
            gap[i, 2] = wrap(gap[i, 2])
            by[i] = whiten[i] @ slopes[i]
            across = np.ascontiguousarray(by[i].T)
            normal += across @ by[i]
            right += across @ (whiten[i] @ gap[i])
        move = np.linalg.solve(normal, right)
        # A step of more than a radian of heading is damped: the fit may start far away.
        reach = np.abs(inner @ move).max()
        parameters += move * min(1.0, 1.0 / max(reach, 1e-9))
        if reach < _SETTLED and max(abs(move[0]), abs(move[1])) < _SETTLED:
            break
    _write_gains(np.linalg.inv(normal), by, whiten, slopes, gain, left_open)
    for q in range(size):
        left_open[:, q] /= weak[q]
