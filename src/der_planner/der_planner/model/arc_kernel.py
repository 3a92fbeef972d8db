"""Compiled functions of one arc.

The shape of an arc, g(z) = ∫₀¹ exp(i z η) dη, has the derivatives iᵏ ∫₀¹ ηᵏ exp(i z η) dη. All are
smooth through z = 0, where the quotients that they can be written as lose their digits: there a
power series is used.
"""

from __future__ import annotations

from math import factorial
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Vector = NDArray[np.float64]

SERIES_BELOW = 0.5
_SERIES = tuple(
    (1.0 / factorial(2 * m) / (2 * m + 4), 1.0 / factorial(2 * m + 1) / (2 * m + 5))
    for m in reversed(range(7))
)
"""Coefficients of (−z²)ᵐ in the real part of ∫₀¹ η³ exp(i z η) dη, and in its imaginary one / z."""


@njit(cache=True, nogil=True)
def arc_moments(z: float) -> Any:
    """Return E_k = ∫₀¹ ηᵏ exp(i z η) dη for k = 0 … 3, to rounding for every real z.

    By parts, i z E_k = exp(i z) − k E_{k−1}. Upward from E_0 this loses digits where z is small:
    there E_3 is taken from its power series, and the others from it, downward.
    """
    phase = complex(np.cos(z), np.sin(z))
    if abs(z) < SERIES_BELOW:
        real, imaginary = 0.0, 0.0
        for even, odd in _SERIES:
            real = real * -z * z + even
            imaginary = imaginary * -z * z + odd
        third = complex(real, z * imaginary)
        second = (phase - complex(-z * third.imag, z * third.real)) / 3.0
        first = 0.5 * (phase - complex(-z * second.imag, z * second.real))
        return phase - complex(-z * first.imag, z * first.real), first, second, third
    inverse = complex(0.0, -1.0 / z)
    zeroth = (phase - 1.0) * inverse
    first = (phase - zeroth) * inverse
    second = (phase - 2.0 * first) * inverse
    return zeroth, first, second, (phase - 3.0 * second) * inverse


@njit(cache=True, nogil=True)
def arc_point(z: float) -> Any:
    """Return g and its first three derivatives at z."""
    zeroth, first, second, third = arc_moments(z)
    return zeroth, 1j * first, -second, -1j * third


@njit(cache=True, nogil=True)
def arcs_and_slopes(z: Vector) -> Any:
    """Return g and its first derivative, each (n,), at every z (n,)."""
    arcs, slopes = np.empty(z.size, dtype=np.complex128), np.empty(z.size, dtype=np.complex128)
    for k in range(z.size):
        zeroth, first, _, _ = arc_moments(z[k])
        arcs[k], slopes[k] = zeroth, 1j * first
    return arcs, slopes
