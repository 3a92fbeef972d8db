"""Lens distortion of Brown and Conrady with the rational terms, both ways, compiled.

Coefficients are ordered as OpenCV and `sensor_msgs/CameraInfo` order them: k1 k2 p1 p2 k3 k4 k5 k6.
Normalised coordinates are x/z, y/z in the camera's optical frame; pixels have the centre of the
first pixel at (0, 0).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

COEFFICIENTS = 8


@njit(cache=True)
def distort(x: float, y: float, d: NDArray[np.float64]) -> tuple[float, float]:
    """Return where the lens puts a normalised point."""
    r2 = x * x + y * y
    radial = (1.0 + r2 * (d[0] + r2 * (d[1] + r2 * d[4]))) / (
        1.0 + r2 * (d[5] + r2 * (d[6] + r2 * d[7]))
    )
    xd = x * radial + 2.0 * d[2] * x * y + d[3] * (r2 + 2.0 * x * x)
    yd = y * radial + d[2] * (r2 + 2.0 * y * y) + 2.0 * d[3] * x * y
    return xd, yd


@njit(cache=True)
def undistort(xd: float, yd: float, d: NDArray[np.float64]) -> tuple[float, float]:
    """Return the normalised point that the lens puts at (xd, yd): Newton with numeric slopes."""
    x, y = xd, yd
    step = 1e-7
    for _ in range(20):
        fx, fy = distort(x, y, d)
        ex, ey = fx - xd, fy - yd
        if abs(ex) + abs(ey) < 1e-13:
            break
        ax, ay = distort(x + step, y, d)
        bx, by = distort(x, y + step, d)
        a, b = (ax - fx) / step, (bx - fx) / step
        c, e = (ay - fy) / step, (by - fy) / step
        determinant = a * e - b * c
        if abs(determinant) < 1e-9:
            break
        x -= (e * ex - b * ey) / determinant
        y -= (a * ey - c * ex) / determinant
    return x, y


@njit(cache=True)
def undistort_pixels(
    pixels: NDArray[np.float64], matrix: NDArray[np.float64], d: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the normalised coordinates (n, 2) of pixels (n, 2)."""
    out = np.empty_like(pixels)
    for i in range(pixels.shape[0]):
        yd = (pixels[i, 1] - matrix[1, 2]) / matrix[1, 1]
        xd = (pixels[i, 0] - matrix[0, 2] - matrix[0, 1] * yd) / matrix[0, 0]
        out[i, 0], out[i, 1] = undistort(xd, yd, d)
    return out


@njit(cache=True)
def distort_to_pixels(
    normalised: NDArray[np.float64], matrix: NDArray[np.float64], d: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the pixels (n, 2) of normalised coordinates (n, 2)."""
    out = np.empty_like(normalised)
    for i in range(normalised.shape[0]):
        xd, yd = distort(normalised[i, 0], normalised[i, 1], d)
        out[i, 0] = matrix[0, 0] * xd + matrix[0, 1] * yd + matrix[0, 2]
        out[i, 1] = matrix[1, 1] * yd + matrix[1, 2]
    return out


@njit(cache=True)
def ray_map(
    width: int, height: int, matrix: NDArray[np.float64], d: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Return the normalised coordinates of every pixel's centre, (height, width, 2)."""
    out = np.empty((height, width, 2), dtype=np.float32)
    for row in range(height):
        yd = (row - matrix[1, 2]) / matrix[1, 1]
        for column in range(width):
            xd = (column - matrix[0, 2] - matrix[0, 1] * yd) / matrix[0, 0]
            x, y = undistort(xd, yd, d)
            out[row, column, 0] = x
            out[row, column, 1] = y
    return out
