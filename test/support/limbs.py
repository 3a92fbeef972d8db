"""Limbs and hardware that differ from the usual in every segment, and plans played on them."""

from dataclasses import replace

import numpy as np

from der_planner.limb import Limb
from der_planner.model import simulate
from der_planner.twin.hardware import DrawnHardware, draw


def with_segments(limb, **changes):
    """Return a limb or hardware whose segments have other values.

    Each is the same for all, or a list of one for each segment, or a function of the segment.
    """

    def value(new, place):
        if isinstance(new, list):
            return new[place]
        return new(limb.segments[place]) if callable(new) else new

    segments = tuple(
        replace(segment, **{name: value(new, place) for name, new in changes.items()})
        for place, segment in enumerate(limb.segments)
    )
    return replace(limb, segments=segments)


def with_air(limb: Limb, **changes: float) -> Limb:
    """Return a limb whose chambers and valves have other values."""
    return replace(limb, pneumatics=replace(limb.pneumatics, **changes))


def of_pressures(limb: Limb, factor: float) -> Limb:
    """Return a limb that does the same under pressures larger by a factor."""
    air = limb.pneumatics
    vent_rate = air.vent_rate * factor ** (1.0 - air.vent_exponent)
    limits = {key: factor * getattr(air, key) for key in ("pressure_limit", "slew_limit")}
    return with_segments(
        with_air(limb, vent_rate=vent_rate, **limits),
        moment_gain=lambda s: s.moment_gain / factor,
        pressure_stiffening=lambda s: s.pressure_stiffening / factor,
    )


def other_limb(gain=0.9, rest=0.035) -> Limb:
    """Return the default limb with a share of its gain and another angle at rest [rad]."""
    return with_segments(
        Limb.default(),
        moment_gain=lambda s: s.moment_gain * gain,
        rest_curvature=lambda s: rest / s.length,
    )


def plain(seed: int = 0, **changes: float) -> DrawnHardware:
    """Return hardware without friction, creep and stiffening: an elastic rod."""
    return with_segments(
        draw(seed),
        cubic_stiffness=0.0,
        pressure_stiffening=0.0,
        elongation=0.0,
        rest_curvature=0.0,
        friction_moment=0.0,
        creep_stiffness=(0.0, 0.0, 0.0),
        wander=0.0,
        coupling=0.0,
        **changes,
    )


def play(planned, limb):
    """Return the tip (K, 2) [m] of another limb under the plan's commands."""
    return simulate(limb, planned.time, commands=planned.differential_pressure).tip[:-1]


def mean_error(planned, tip):
    return np.linalg.norm(tip - planned.tip_reference, axis=1).mean()
