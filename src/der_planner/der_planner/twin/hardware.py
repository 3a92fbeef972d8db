"""What a seed draws: the hardware of one trial, with what planners do not know.

The ranges stand in `RANGES`, around the limb of `Limb.default()`. Nothing here is written to a
topic, a file or a log that a planner reads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

SEGMENT_LENGTH = 0.122
"""Material length of one segment with its share of the fittings [m]."""
NOMINAL_GAIN = np.deg2rad(0.36) / 100.0
"""Bend angle per differential pressure of the nominal segment [rad/Pa]."""
NOMINAL_STIFFNESS = 0.0175
"""EI of the nominal segment [N·m²]."""

RANGES: dict[str, tuple[float, float]] = {
    "gain_of_the_day": (0.80, 1.20),  # × nominal, both segments alike
    "gain_of_a_segment": (0.90, 1.10),  # × nominal, each segment
    "gain_of_a_chamber": (0.95, 1.05),  # × the segment's, each chamber
    "bending_stiffness": (0.85, 1.15),  # × nominal
    "pressure_stiffening": (0.01, 0.05),  # relative EI at a chamber gauge pressure of 10 kPa
    "cubic_stiffening": (0.01, 0.06),  # relative secant stiffness at 45° of bend
    "rest_angle": (-3.0, 3.0),  # [deg] each segment
    "loop_first": (0.06, 0.12),  # friction loop width over a span of 60°, first segment
    "loop_second": (0.02, 0.06),  # second segment
    "yield_angle": (6.0, 14.0),  # [deg] of bend over which friction turns round
    "friction_exponent": (1.2, 2.0),  # sharpness of the knee of the friction
    "friction_share": (0.55, 0.85),  # share of the friction's decay that reversal switches off
    "slow_creep": (0.01, 0.03),  # slow share of the stiffness
    "slow_creep_time": (30.0, 90.0),  # [s]
    "creep": (0.01, 0.03),  # middle share of the stiffness
    "creep_time": (3.0, 9.0),  # [s]
    "fast_creep": (0.15, 0.35),  # fast share of the stiffness
    "fast_creep_time": (0.02, 0.05),  # [s]
    "wander": (0.1, 0.3),  # [deg] standard deviation of the rest angle within a run
    "wander_time": (60.0, 180.0),  # [s] correlation time of it
    "elongation": (0.001, 0.003),  # strain at a chamber gauge pressure of 10 kPa
    "end_fitting": (0.006, 0.010),  # [m] stiff length at the clamp and at the tip
    "connector": (0.006, 0.012),  # [m] stiff length between the segments
    "fitting_mass": (0.004, 0.010),  # [kg] of the connector and of the tip, with tags
    "mass_per_length": (0.95, 1.05),  # × 1.066 kg/m
    "drag": (0.4, 0.7),  # [1/s] mass-proportional damping
    "coupling": (-0.05, 0.05),  # moment by the other segment's pressure, over that of its own
}
"""Uniform ranges of every number that a seed draws."""

LOOP_SPAN = np.deg2rad(60.0)


@dataclass(frozen=True)
class SegmentHardware:
    """One segment as built.

    Attributes:
        flexible_length: of the silicone between its fittings [m].
        bending_stiffness: EI of the silicone at atmosphere [N·m²].
        cubic_stiffness: k3 in M = EI κ + k3 κ³ [N·m⁴].
        pressure_stiffening: relative growth of EI per gauge pressure of a chamber [1/Pa].
        chamber_gain: bending moment per gauge pressure of the left and the right chamber [N·m/Pa].
        elongation: axial strain per gauge pressure of a chamber [1/Pa].
        rest_curvature: at atmosphere [1/m].
        friction_moment: saturation of the friction between silicone and fibre [N·m].
        friction_curvature: change of curvature over which the friction turns round [1/m].
        friction_exponent, friction_share: n and β of its Bouc-Wen law.
        creep_stiffness, creep_time: Maxwell branches, fast, middle and slow [N·m²], [s].
        coupling: moment by the neighbours' differential pressure over that of its own [-].
        wander, wander_time: standard deviation [1/m] and correlation time [s] of the rest
            curvature.
    """

    flexible_length: float
    bending_stiffness: float
    cubic_stiffness: float
    pressure_stiffening: float
    chamber_gain: tuple[float, float]
    elongation: float
    rest_curvature: float
    friction_moment: float
    friction_curvature: float
    friction_exponent: float
    friction_share: float
    creep_stiffness: tuple[float, float, float]
    creep_time: tuple[float, float, float]
    wander: float
    wander_time: float
    coupling: float = 0.0


@dataclass(frozen=True)
class DrawnHardware:
    """A two-segment limb as built.

    Attributes:
        segments: (M,) from the clamp to the tip.
        base_fitting, connector, tip_fitting: stiff lengths [m].
        connector_mass, tip_mass: of what sits on the stiff parts [kg].
        mass_per_length: of the silicone [kg/m].
        drag: mass-proportional damping [1/s].
    """

    segments: tuple[SegmentHardware, ...]
    base_fitting: float
    connector: float
    tip_fitting: float
    connector_mass: float
    tip_mass: float
    mass_per_length: float
    drag: float


def draw(seed: int) -> DrawnHardware:
    """Draw the hardware of one trial; the same seed gives the same hardware."""
    generator = np.random.default_rng([20_260, seed])

    def of(name: str) -> float:
        low, high = RANGES[name]
        return float(generator.uniform(low, high))

    day = of("gain_of_the_day")
    base, connector, tip = of("end_fitting"), of("connector"), of("end_fitting")
    ends = (base, tip)
    segments = []
    for index in range(2):
        length = SEGMENT_LENGTH - ends[index] - 0.5 * connector
        stiffness = NOMINAL_STIFFNESS * of("bending_stiffness")
        gain = NOMINAL_GAIN * day * of("gain_of_a_segment") * stiffness / length
        largest = np.deg2rad(45.0) / length
        loop = of("loop_first" if index == 0 else "loop_second")
        segments.append(
            SegmentHardware(
                flexible_length=length,
                bending_stiffness=stiffness,
                cubic_stiffness=stiffness * of("cubic_stiffening") / largest**2,
                pressure_stiffening=of("pressure_stiffening") / 1e4,
                chamber_gain=(gain * of("gain_of_a_chamber"), gain * of("gain_of_a_chamber")),
                elongation=of("elongation") / 1e4,
                rest_curvature=float(np.deg2rad(of("rest_angle"))) / length,
                friction_moment=0.5 * loop * LOOP_SPAN / length * stiffness,
                friction_curvature=float(np.deg2rad(of("yield_angle"))) / length,
                friction_exponent=of("friction_exponent"),
                friction_share=of("friction_share"),
                creep_stiffness=(
                    stiffness * of("fast_creep"),
                    stiffness * of("creep"),
                    stiffness * of("slow_creep"),
                ),
                creep_time=(of("fast_creep_time"), of("creep_time"), of("slow_creep_time")),
                wander=float(np.deg2rad(of("wander"))) / length,
                wander_time=of("wander_time"),
            )
        )
    hardware = DrawnHardware(
        segments=tuple(segments),
        base_fitting=base,
        connector=connector,
        tip_fitting=tip,
        connector_mass=of("fitting_mass"),
        tip_mass=of("fitting_mass"),
        mass_per_length=1.066 * of("mass_per_length"),
        drag=of("drag"),
    )
    coupled = tuple(replace(segment, coupling=of("coupling")) for segment in segments)
    return replace(hardware, segments=coupled)


@dataclass(frozen=True)
class KnownValue:
    """A number that the twin knows.

    Attributes:
        value: in the unit of the report.
        spread: standard deviation with which it wanders from run to run.
    """

    value: float
    spread: float = 0.0


def known_values(hardware: DrawnHardware) -> dict[str, KnownValue]:
    """Return what a fit should find, by the names of `FitReport.unknowns`, e.g. ``gain[0]``.

    Only tests and studies read this. What the two descriptions do not share has no entry: lengths
    of fittings that the rod's mesh lumps, masses, the two relaxation times that one creep element
    stands for, and stiffness and damping of the moving limb, to which small strokes of friction
    add.
    """
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
