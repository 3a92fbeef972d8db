"""Limbs and hardware that differ from the usual in every segment, and plans played on them."""

from dataclasses import replace

import numpy as np

from der_planner.limb import Limb
from der_planner.model import simulate
from der_planner.twin.hardware import DrawnHardware, draw


def with_segments(limb, **changes):
    """Return a limb or hardware with new values, or functions of a segment, in each segment."""

    def changed(segment):
        return {name: new(segment) if callable(new) else new for name, new in changes.items()}

    return replace(limb, segments=tuple(replace(s, **changed(s)) for s in limb.segments))


def of_pressures(limb: Limb, factor: float) -> Limb:
    """Return a limb that does the same under pressures larger by a factor."""
    air = limb.pneumatics
    vent_rate = air.vent_rate * factor ** (1.0 - air.vent_exponent)
    limits = {key: factor * getattr(air, key) for key in ("pressure_limit", "slew_limit")}
    limb = replace(limb, pneumatics=replace(air, vent_rate=vent_rate, **limits))
    return with_segments(
        limb,
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
