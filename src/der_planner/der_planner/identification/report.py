"""Results of a calibration: values, uncertainties, residuals, what a log cannot separate."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from der_planner.arrays import Array
from der_planner.identification.air import AirFit
from der_planner.identification.lengths import GeometryFit
from der_planner.limb import Limb
from der_planner.limb.parameters import REST_SPREAD
from der_planner.model.resting import weight_of


@dataclass(frozen=True)
class Unknown:
    """One identified number.

    Attributes:
        name: with the segment in brackets.
        unit: of the value.
        value: identified.
        deviation: standard deviation.
        untold: the data say next to nothing of it; its spread is the prior's.
        at_bound: the value sits at a bound of its range.
    """

    name: str
    unit: str
    value: float
    deviation: float
    untold: bool = False
    at_bound: bool = False


@dataclass(frozen=True)
class LoadsFit:
    """The mass that bends the limb by its weight, and the stiffness that carries it.

    Attributes:
        gravity: (2,) in the plane [m/s²].
        mass: `Limb.moving_mass`, without what sits on the stiff base [kg].
        first_moment: of that about the clamp, of the straight limb [kg·m].
        stiffness: (M,) EI [N·m²].
    """

    gravity: tuple[float, float]
    mass: float
    first_moment: float
    stiffness: tuple[float, ...]


def loads_of(limb: Limb) -> LoadsFit | None:
    """Return mass, first moment and stiffness of a limb; None without gravity in its plane."""
    if not limb.weighs_in_plane:
        return None
    straight = replace(limb, gravity=(0.0, 1.0, 0.0))
    weight = weight_of(straight)
    count = limb.segment_count
    mass = limb.moving_mass
    return LoadsFit(
        (limb.gravity[0], limb.gravity[1]),
        float(mass),
        float(weight.lever.sum() + limb.base_length * mass),
        tuple(s.bending_stiffness for s in limb.segments[:count]),
    )


@dataclass(frozen=True)
class FitReport:
    """What a fit found, and how well.

    Attributes:
        source: of the log.
        unknowns: (P,) with standard deviations.
        correlation: (P, P) of the unknowns.
        strongly_correlated: pairs that the log cannot tell apart.
        air: fit of the chambers; None if the log has no smooth commands.
        geometry: fit of the lengths; None if the log has no tips.
        residual, largest: (M,) root mean square and largest bend angle error of the rod [rad].
        pcc_residual: (M,) root mean square error of the PCC model [rad]; NaN where it shares all
            numbers.
        span: (M,) range of the measured bend angles [rad].
        duration: of the log [s].
        rows: used by the fit.
        evaluations: of model and derivatives.
        fit_time: [s].
        warnings: sentences.
        loads: the limb's weight and what carries it; None without gravity in the plane.
    """

    source: str
    unknowns: tuple[Unknown, ...]
    correlation: Array
    strongly_correlated: tuple[tuple[str, str, float], ...]
    air: AirFit | None
    geometry: GeometryFit | None
    residual: Array
    largest: Array
    pcc_residual: Array
    span: Array
    duration: float
    rows: int
    evaluations: int
    fit_time: float
    warnings: tuple[str, ...] = ()
    loads: LoadsFit | None = None

    def value(self, name: str) -> Unknown:
        """Return the unknown of this name, e.g. ``gain[0]``.

        Raises:
            KeyError: it was not fitted.
        """
        for unknown in self.unknowns:
            if unknown.name == name:
                return unknown
        raise KeyError(name)

    def text(self) -> str:
        """Return the report as text for people."""
        lines = [
            f"Calibration from {self.source or 'a log'}: {self.duration:.0f} s, {self.rows} rows, "
            f"fitted in {self.fit_time:.1f} s ({self.evaluations} evaluations)",
            "",
            f"{'unknown':26s} {'value':>12s} {'std':>10s}  unit",
        ]
        for item in self.unknowns:
            value, deviation, unit = _readable(item)
            note = "  the data hardly tell it" if item.untold else ""
            note += "  at its bound" if item.at_bound else ""
            lines.append(f"{item.name:26s} {value:12.4g} {deviation:10.2g}  {unit}{note}")
        lines.append("")
        for index, (error, largest, pcc, span) in enumerate(
            zip(self.residual, self.largest, self.pcc_residual, self.span, strict=True)
        ):
            other = f" (PCC rms {math.degrees(pcc):.2f}°)" if math.isfinite(pcc) else ""
            lines.append(
                f"segment {index}: bend angle error rms {math.degrees(error):.2f}°, "
                f"max {math.degrees(largest):.2f}°, {100 * error / max(span, 1e-9):.2f} % of "
                f"its range{other}"
            )
        lines += self._air_lines() + self._geometry_lines() + self._load_lines()
        for first, second, value in self.strongly_correlated:
            lines.append(
                f"the log cannot tell {first} and {second} apart (correlation {value:+.2f})"
            )
        lines += [f"warning: {warning}" for warning in self.warnings]
        return "\n".join(lines)

    def _air_lines(self) -> list[str]:
        if self.air is None:
            return []
        air = self.air
        number, deviation = air.numbers, air.deviations
        # A run without fast steps never shows how fast a chamber fills.
        seen = np.isfinite(air.fill_rate)
        rate = f"{air.fill_rate:.0f} Pa/s" if seen else "not shown by this run"
        venting = "how slowly chambers are venting: not shown by this run, kept"
        if "vent_rate" in number:
            venting = (
                f"a vented chamber falls by at most {number['vent_rate']:.0f} ± "
                f"{deviation['vent_rate']:.0f} Pa/s at 10 kPa, with the pressure to the power "
                f"{number['vent_exponent']:.2f} ± {deviation['vent_exponent']:.2f}"
            )
        lag = f"{number['vent_time_constant']:.3f} s venting"
        if number.get("vent_lag_exponent"):
            lag += f" at 10 kPa · (10 kPa / pressure)^{number['vent_lag_exponent']:.2f}"
        return [
            f"air: lag {number['time_constant']:.3f} s filling, {lag}, dead time "
            f"{number['delay']:.3f} s, fill rate {rate}, residual {air.residual:.0f} Pa",
            f"air: {venting}",
        ]

    def _geometry_lines(self) -> list[str]:
        if self.geometry is None:
            return []
        geometry = self.geometry
        lengths = ", ".join(
            f"{1e3 * length:.1f} ± {1e3 * deviation:.1f}"
            for length, deviation in zip(geometry.lengths, geometry.uncertainty, strict=False)
        )
        return [
            f"lengths: {lengths} mm, connector {1e3 * geometry.connector:.1f} mm, stiff base "
            f"{1e3 * geometry.base:.1f} mm; tips within "
            f"{1e3 * geometry.residual:.2f} mm of an evenly bent rod at the measured angles "
            f"(with the prior's lengths {1e3 * geometry.residual_before:.2f} mm)"
        ]

    def _load_lines(self) -> list[str]:
        if self.loads is None:
            return []
        loads = self.loads
        pull = math.hypot(*loads.gravity)
        line = (
            f"loads: gravity of {pull:.2f} m/s² in the plane pulls at {1e3 * loads.mass:.0f} g "
            f"beyond the base, first moment {1e3 * loads.first_moment:.1f} g·m about the clamp"
        )
        known = {u.name: u for u in self.unknowns}
        kept = "the mass" if "log_stiffness[0]" in known else "the stiffness"
        told = []
        for index, stiffness in enumerate(loads.stiffness):
            if f"log_stiffness[{index}]" in known:
                share = known[f"log_stiffness[{index}]"].deviation
                told.append(f"EI of segment {index} = {stiffness:.4f} N·m² ± {100 * share:.1f} %")
            if f"log_mass[{index}]" in known:
                found = known[f"log_mass[{index}]"]
                told.append(
                    f"mass of segment {index} = prior × {math.exp(found.value):.3f} ± "
                    f"{100 * found.deviation:.1f} %"
                )
        if not told:
            return [line]
        return [
            line,
            f"loads: weight tells stiffness from gain: {', '.join(told)}",
            f"loads: stiffness, gain and mass scale together, {kept} was given; condition of "
            f"gains, rest angles and stiffness or mass: {self.condition:.0f}",
            *self._made_straight(),
        ]

    def _made_straight(self) -> list[str]:
        """Say of which segments the stiffness rests on what is known of rest angles beforehand."""
        alike = {frozenset(pair[:2]) for pair in self.strongly_correlated}
        found = [
            str(index)
            for index in range(len(self.residual))
            if {f"log_stiffness[{index}]", f"rest_angle[{index}]"} in alike
        ]
        if not found:
            return []
        return [
            f"loads: weight and rest angle bend segment {', '.join(found)} alike here: the "
            f"stiffness holds for a limb that was made straight, ± {math.degrees(REST_SPREAD):.0f}°"
        ]

    @property
    def condition(self) -> float:
        """Of the correlation of gains, rest angles and stiffnesses or masses: 1 is all apart."""
        names = ("gain[", "rest_angle[", "log_stiffness[", "log_mass[")
        rows = [i for i, u in enumerate(self.unknowns) if u.name.startswith(names)]
        return float(np.linalg.cond(self.correlation[np.ix_(rows, rows)]))


def _readable(item: Unknown) -> tuple[float, float, str]:
    """Return value, deviation and unit as people read them: degrees and hPa."""
    factor, unit = {
        "rad/Pa": (math.degrees(1.0) * 100.0, "deg/hPa"),
        "rad": (math.degrees(1.0), "deg"),
        "1/Pa": (1e6, "% per 10 kPa"),
        "1/rad²": (100.0 * math.radians(45.0) ** 2, "% at 45 deg"),
        "Pa": (0.01, "hPa"),
        "Pa/rad": (0.01 * math.radians(45.0), "hPa at 45 deg"),
    }.get(item.unit, (1.0, item.unit))
    return item.value * factor, item.deviation * factor, unit
