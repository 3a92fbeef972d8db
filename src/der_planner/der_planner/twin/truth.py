"""What a seed drew, in the terms of a calibration's report: the numbers that a fit should find.

Only tests and benchmarks read this. What the two descriptions do not share has no entry: lengths of
fittings that the rod's mesh lumps, masses, the two relaxation times that one creep element stands
for, and stiffness and damping of the moving limb, to which small strokes of friction add.
"""

from __future__ import annotations

from dataclasses import dataclass

from der_planner.twin.hardware import Hardware


@dataclass(frozen=True)
class KnownValue:
    """A number that the twin knows.

    Attributes:
        value: in the unit of the report.
        spread: standard deviation with which it wanders from run to run.
    """

    value: float
    spread: float = 0.0


def known_values(hardware: Hardware) -> dict[str, KnownValue]:
    """Return the known values by the names of `FitReport.unknowns`, e.g. ``gain[0]``."""
    known: dict[str, KnownValue] = {}
    last = len(hardware.segments) - 1
    for index, segment in enumerate(hardware.segments):
        left, right = segment.chamber_gain
        gain, length = 0.5 * (left + right), segment.flexible_length
        stiffness = segment.bending_stiffness
        values = {
            "gain": gain * length / stiffness,
            "gain_asymmetry": 0.5 * (left - right) / gain,
            "pressure_stiffening": segment.pressure_stiffening,
            "cubic": segment.cubic_stiffness / (stiffness * length**2),
            "friction_pressure": segment.friction_moment / gain,
            "friction_angle": segment.friction_curvature * length,
            # the fast element is damping; one element of the fit stands for the other two
            "creep_pressure": sum(segment.creep_stiffness[1:]) / (length * gain),
        }
        if index > 0:
            values["coupling_before"] = segment.coupling
        if index < last:
            values["coupling_after"] = segment.coupling
        for name, value in values.items():
            known[f"{name}[{index}]"] = KnownValue(value)
        rest, wander = segment.rest_curvature * length, segment.wander * length
        known[f"rest_angle[{index}]"] = KnownValue(rest, wander)
    return known
