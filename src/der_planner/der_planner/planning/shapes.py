"""Shapes that the tip can draw: circle, figure eight, line and star."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from der_planner.model.bending import Kinematics
from der_planner.planning.paths import TipPath, polygon

Array = NDArray[np.float64]

NAMES = ("circle", "figure_eight", "line", "star")

SIZE = 0.04
"""Radius (half length) of a shape over the limb's length, at an amplitude of 45 degrees."""
_POINTS = 50


def draw(
    name: str,
    kinematics: Kinematics,
    amplitude: float,
    period: float,
    cycles: int,
    sag: Array | None = None,
) -> TipPath:
    """Return a shape as a timed path around the tip of a limb bent by 1.2 times the amplitude.

    Curves start and end at rest by a fade of their phase over the first and last quarter of a
    period; polygons rest at each corner.

    Args:
        name: one of `NAMES`.
        kinematics: of the arcs.
        amplitude: bend angle that sets place and size [rad].
        period: of one cycle [s].
        cycles: how many.
        sag: (M,) bend angles from which the amplitude counts [rad]; None: straight.
    """
    bend = np.full(kinematics.segment_count, 1.2 * amplitude)
    if sag is not None:
        bend = bend + sag
    centre = kinematics.tip(bend)
    length = float(kinematics.tip(np.zeros(kinematics.segment_count))[0])
    radius = SIZE * length * amplitude / (np.pi / 4)
    heading = float(bend.sum()) / 2
    along = np.array([np.cos(heading), np.sin(heading)])
    across = np.array([-along[1], along[0]])
    if name in ("line", "star"):
        corners = np.array(_corners(name))
        points = centre + radius * (corners[:, :1] * along + corners[:, 1:] * across)
        loop = np.concatenate([points] + [points[1:]] * (cycles - 1))
        return polygon(loop, period * cycles)
    total = period * cycles
    time = np.linspace(0.0, total + period / 4, _POINTS * 4 * cycles + 1)
    phase = 2 * np.pi * _faded_phase(time / period, cycles)
    if name == "circle":
        local = np.column_stack([np.cos(phase), np.sin(phase)])
    else:
        local = np.column_stack([np.sin(2 * phase) / 2, np.sin(phase)])
    points = centre + radius * (local[:, :1] * along + local[:, 1:] * across)
    return TipPath(time, points)


def _faded_phase(turns: Array, cycles: int) -> Array:
    """Return the phase in turns: rate from 0 to 1 over a quarter turn, and back to 0 at the end."""
    fade = 0.25
    total = cycles + fade

    def ramp(x: Array) -> Array:
        t = np.clip(x / fade, 0.0, 1.0)
        area: Array = fade * (2.5 * t**4 - 3 * t**5 + t**6)
        return area

    start = np.where(turns < fade, ramp(turns), fade / 2 + (turns - fade))
    end = fade / 2 + (total - fade - fade) + fade / 2 - ramp(total - turns)
    return np.where(turns > total - fade, end, start)


def _corners(name: str) -> list[tuple[float, float]]:
    if name == "line":
        return [(0.0, -1.0), (0.0, 1.0), (0.0, -1.0)]
    turns = np.arange(6) * 2 / 5
    return [(float(np.cos(2 * np.pi * t)), float(np.sin(2 * np.pi * t))) for t in turns]
