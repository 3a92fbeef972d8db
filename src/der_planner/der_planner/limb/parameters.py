"""The parameters of a limb, each declared once: unit, meaning, how to choose it, range, fit.

Checks, comments in limb files, the site's page and the unknowns of the fit follow from here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from der_planner.limb.declaration import Term, effect, parameter, positive, signed_effect

VENT_REFERENCE = 10e3
"""Gauge pressure [Pa] for which `Pneumatics.vent_rate` is given."""
REST_SPREAD = math.radians(5.0)
"""Of the rest angles of limbs that are made straight [rad]. Without gravity a log tells them to a
fraction of this; under it a rest angle and a compliance bend the resting limb alike."""


@dataclass(frozen=True)
class Segment:
    """One actuated segment: a uniform rod with a pair of opposed chambers.

    The parameters from `gain_asymmetry` on are those of `der_planner.model.material`, which turns
    the differential pressure into the effective one that drives the rod and the PCC model. All
    zero: the two are the same.
    """

    length: float = parameter(
        "m",
        "actuated length",
        "measure what bends; the calibration corrects it by the tip",
        interval="(0, 5]",
    )
    bending_stiffness: float = positive(
        "N·m²",
        "bending stiffness EI",
        "hold it level, hang a small force F on its end: EI = F L³ / (3 · extra deflection)",
        fit=Term(
            *("log_stiffness", "-", 0.2, -1.2, 1.2, 0.3, "dynamics"),
            relative=True,
            kept=True,
        ),
    )
    axial_stiffness: float = positive(
        "N",
        "stretching stiffness EA",
        "pull it: force · length / extension; its value hardly matters far above EI / L²",
    )
    torsional_stiffness: float = positive(
        "N·m²",
        "twisting stiffness GJ, which only the rod in space reads",
        "a round section of incompressible rubber has 2/3 EI",
    )
    mass_per_length: float = positive(
        "kg/m",
        "mass per length",
        "weigh it, divide by its length",
        fit=Term(*("log_mass", "-", 0.1, -1.2, 1.2, 0.3, "mass"), relative=True, kept=True),
    )
    damping: float = parameter(
        "1/s",
        "damping force per mass and velocity, by air and plate",
        "twice the rate at which the amplitude of a free swing decays",
        interval="[0, inf)",
        fit=Term(
            *("log_damping", "-", 0.5, -3.0, 3.0, 0.5, "dynamics"),
            shared=True,
            relative=True,
            kept=True,
        ),
    )
    moment_gain: float = positive(
        "N·m/Pa",
        "bending moment per differential pressure G",
        "bend angle at a slow pressure / pressure · EI / L; leave it to the calibration",
        fit=Term(
            *("gain", "rad/Pa", 1.2, 0.12, 12.0, math.inf, "linear"),
            per_limit=-1,
            per={"length": 1, "bending_stiffness": -1},
        ),
    )
    rest_curvature: float = signed_effect(
        "1/m",
        "signed curvature at zero differential pressure, positive toward +y",
        "bend angle at rest / length; leave it to the calibration",
        fit=Term(*("rest_angle", "rad", 0.02, -0.6, 0.6, REST_SPREAD, "linear"), per={"length": 1}),
    )
    cubic_stiffness: float = signed_effect(
        "N·m⁴",
        "k3 in moment = EI (κ − κ̄) + k3 (κ − κ̄)³",
        "0 unless large bends fall short of small ones in proportion; calibration",
        fit=Term(
            *("cubic", "1/rad²", 0.05, -0.2, 0.5, 0.05, "cubic"),
            per={"bending_stiffness": -1, "length": -2},
        ),
    )
    material_damping: float = effect(
        "s",
        "Kelvin-Voigt time τ in moment = EI (κ + τ κ̇)",
        "0.01 takes away ringing that a real limb does not show; calibration with fast motion",
        fit=Term(*("material_damping", "s", 0.01, 0.0, 0.1, 0.02, "dynamics"), kept=True),
    )
    swing_inertia: float = positive(
        "-",
        "mass that resists acceleration over mass that weighs",
        "1; less stands for friction, which stiffens small fast strokes; calibration",
        default=1.0,
        fit=Term(
            *("log_inertia", "-", 0.1, -0.7, 0.7, 0.2, "dynamics"),
            shared=True,
            relative=True,
            kept=True,
        ),
    )
    gain_asymmetry: float = signed_effect(
        "-",
        "relative gain of the left over the mean of both chambers",
        "(left − right) / (left + right) of the bend angles by equal pressures; calibration",
        interval="(-1, 1)",
        fit=Term("gain_asymmetry", "-", 0.03, -0.4, 0.4, 0.1, "asymmetry"),
    )
    pressure_stiffening: float = signed_effect(
        "1/Pa",
        "relative growth of the stiffness per |differential pressure|",
        "0, or from the calibration, which hardly tells it from cubic_stiffness",
        fit=Term(
            "pressure_stiffening", "1/Pa", 0.072, -0.48, 0.72, 0.24, "stiffening", per_limit=-1
        ),
    )
    friction_moment: float = effect(
        "N·m",
        "saturation of a Dahl friction element",
        "half of the pressure between the branches of a slow loop · moment_gain; calibration",
        fit=Term(
            *("friction_pressure", "Pa", 0.0125, 0.0, 1 / 6, 1 / 30, "friction"),
            per={"moment_gain": -1},
            start=1 / 120,
            per_limit=1,
        ),
    )
    friction_curvature: float = effect(
        "1/m",
        "change of curvature over which friction turns round",
        "bend angle in which a reversal has made 63 % of its way / length; calibration",
        needs="friction_moment",
        fit=Term(
            *("friction_angle", "rad", 0.1, 0.02, 0.8, 0.1, "friction"),
            per={"length": 1},
            start=0.1,
        ),
    )
    creep_stiffness: float = effect(
        "N·m²",
        "stiffness of a Maxwell element beside EI",
        "EI · relative growth of the bend angle while a pressure is held; calibration",
        fit=Term(
            *("creep_pressure", "Pa/rad", 1 / 48, 0.0, 0.625, 1 / 12, "creep"),
            per={"moment_gain": -1, "length": -1},
            start=1 / 60,
            per_limit=1,
        ),
    )
    creep_time: float = effect(
        "s",
        "relaxation time of the Maxwell element",
        "time in which that growth has come to 63 %; calibration",
        needs="creep_stiffness",
        fit=Term("creep_time", "s", 15.0, 3.0, 120.0, 15.0, "creep", start=15.0),
    )
    coupling_before: float = signed_effect(
        "-",
        "moment by the pressure of the segment before, over that of its own: tubes, walls",
        "pressurise the segment before alone: bend here / bend there, if alike; calibration",
        interval="(-0.5, 0.5)",
        fit=Term("coupling_before", "-", 0.03, -0.4, 0.4, 0.05, "coupling", neighbour=-1),
    )
    coupling_after: float = signed_effect(
        "-",
        "moment by the pressure of the segment after, over that of its own: tubes, walls",
        "pressurise the segment after alone: bend here / bend there, if alike; calibration",
        interval="(-0.5, 0.5)",
        fit=Term("coupling_after", "-", 0.03, -0.4, 0.4, 0.05, "coupling", neighbour=1),
    )

    @property
    def static_gain(self) -> float:
        """Bend angle per differential pressure where the segment is linear, G L / EI [rad/Pa]."""
        return self.moment_gain * self.length / self.bending_stiffness


@dataclass(frozen=True)
class Pneumatics:
    """How a commanded differential pressure becomes a measured one, and what may be asked for."""

    RETIRED: ClassVar = ("fill_rate", "minimum_supply")
    """Keys in older limb files that nothing reads any more."""

    pressure_limit: float = positive(
        "Pa",
        "largest |differential pressure| of a plan",
        "what the chambers bear for good, at most the driver's pressure_limit",
    )
    slew_limit: float = positive(
        "Pa/s",
        "largest |change of a commanded differential pressure| per second",
        "at most the fill rate that the calibration's report names, and the driver's limit",
    )
    time_constant: float = positive(
        "s",
        "first-order lag from command to chamber",
        "from the calibration",
    )
    delay: float = effect(
        "s",
        "dead time from command to the first change in the chamber",
        "from the calibration",
    )
    vent_time_constant: float = effect(
        "s",
        "lag while |differential pressure| falls; 0: as time_constant",
        "from the calibration",
    )
    vent_rate: float = effect(
        "Pa/s",
        "fall of a chamber at 10 kPa with its outlet wide open; 0: no limit",
        "from the calibration, or the steepest fall after a step from 10 kPa to 0",
    )
    vent_exponent: float = parameter(
        "-",
        "the fall grows with this power of the chamber's gauge pressure",
        "1/2 is an orifice, 1 a tube (one exponential); a real limb had 2/3; calibration",
        default=2.0 / 3.0,
        interval="(0, 1]",
    )

    vent_lag_exponent: float = signed_effect(
        "-",
        "vent_time_constant is that at 10 kPa and falls with this power of the chamber's gauge "
        "pressure; 0: the same at all pressures",
        "as vent_exponent for a valve that opens in proportion to its error; calibration",
        interval="[0, 1]",
    )

    @property
    def vent_lag(self) -> float:
        """First-order lag while |differential pressure| falls [s]."""
        return self.vent_time_constant or self.time_constant


@dataclass(frozen=True)
class CalibratedRange:
    """What a calibration run covered, so that a plan beyond it can be recognised."""

    differential_pressure: tuple[float, ...] = parameter(
        "Pa",
        "largest |differential pressure| seen",
        "the calibration writes it",
        default=(),
        interval="[0, inf)",
    )
    bend_angle: tuple[float, ...] = parameter(
        "rad",
        "largest |bend angle| seen",
        "the calibration writes it",
        default=(),
        interval="[0, inf)",
    )
    gravity: tuple[float, ...] = parameter(
        "m/s²",
        "gravity for which the limb's numbers were found; empty: the limb's gravity",
        "leave it empty: it is noted where a run is mounted otherwise than the limb file",
        default=(),
    )
    bending_stiffness: tuple[float, ...] = parameter(
        "N·m²",
        "stiffness that swings or a known weight told, by which the force of a touch counts; "
        "empty: the segments' own",
        "the calibration writes it",
        default=(),
        interval="(0, inf)",
    )
    free_level: str = parameter(
        "-",
        "numbers of what the model lacks while nothing touches the limb",
        "the calibration writes it; without it a first run feels touch less",
        default="",
    )
