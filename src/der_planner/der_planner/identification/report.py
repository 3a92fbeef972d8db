"""What a fit says of itself: values, uncertainties, what cannot be told apart, residuals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from der_planner.identification.air import AirFit
from der_planner.identification.geometry import GeometryFit

Array = NDArray[np.float64]


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
class FitReport:
    """What a fit found, and how well.

    Attributes:
        source: of the log.
        unknowns: (P,) with standard deviations.
        correlation: (P, P) of the unknowns.
        strongly_correlated: pairs that the log cannot tell apart.
        untold: names of unknowns whose spread is the prior's still.
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
    """

    source: str
    unknowns: tuple[Unknown, ...]
    correlation: Array
    strongly_correlated: tuple[tuple[str, str, float], ...]
    untold: tuple[str, ...]
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
        lines += self._air_lines() + self._geometry_lines()
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
        # A run without fast steps never shows how fast a chamber fills.
        seen = np.isfinite(air.fill_rate)
        rate = f"{air.fill_rate:.0f} Pa/s" if seen else "not shown by this run"
        venting = "how slowly chambers are venting: not shown by this run, kept"
        if math.isfinite(air.vent_rate):
            speed, exponent = air.vent_uncertainty
            venting = (
                f"a vented chamber falls by at most {air.vent_rate:.0f} ± {speed:.0f} Pa/s at "
                f"10 kPa, with the pressure to the power {air.vent_exponent:.2f} ± {exponent:.2f}"
            )
        return [
            f"air: lag {air.fill_lag:.3f} s filling, {air.vent_lag:.3f} s venting, dead time "
            f"{air.delay:.3f} s, fill rate {rate}, residual {air.residual:.0f} Pa",
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
