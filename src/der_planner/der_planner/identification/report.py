"""What a calibration found, and how a limb file does on a later run: numbers, text, a figure."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from der_planner.arrays import Array
from der_planner.identification.air import AirFit
from der_planner.identification.lengths import GeometryFit
from der_planner.identification.log import LEAST_MOTION, CalibrationLog, LogError, bridge, prepare
from der_planner.limb import Limb
from der_planner.limb.parameters import REST_SPREAD
from der_planner.model import CONTROL_PERIOD, Model, Response, simulate
from der_planner.model.air import Air
from der_planner.model.resting import weight_of

GAIN_DRIFT = 0.08
"""Relative change of a gain above which the limb must be calibrated again."""
REST_DRIFT = math.radians(1.5)
"""Change of a rest angle above which the limb must be calibrated again [rad]."""
ERROR_GROWTH = 2.5
"""Error over the calibration's own error above which the limb must be calibrated again."""
LEAST_ERROR = math.radians(0.4)
"""Least error of a calibration that `ERROR_GROWTH` multiplies [rad]."""
STRONG = 0.9
"""|correlation| above which two unknowns are reported as a pair that the log cannot tell apart."""


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
        limb: that was found, under the loads of the log.
        source: of the log.
        unknowns: (P,) with standard deviations.
        correlation: (P, P) of the unknowns.
        air: fit of the chambers; None if the log has no smooth commands.
        geometry: fit of the lengths; None if the log has no tips.
        residual, largest: (M,) root mean square and largest bend angle error of the rod [rad].
        pcc_residual: (M,) root mean square error of the PCC model [rad]; NaN where it shares all
            numbers.
        span: (M,) range of the measured bend angles [rad].
        duration: of the log [s].
        rows: used by the fit.
        delay: by which what was seen is late, and its standard deviation [s].
        taken_out: the part of it that was taken off the stamps before the fit [s].
        warnings: sentences.
        weight: sentence on the known weight in the log, if there is one.
    """

    limb: Limb
    source: str
    unknowns: tuple[Unknown, ...]
    correlation: Array
    air: AirFit | None
    geometry: GeometryFit | None
    residual: Array
    largest: Array
    pcc_residual: Array
    span: Array
    duration: float
    rows: int
    delay: tuple[float, float] = (math.nan, math.nan)
    taken_out: float = 0.0
    warnings: tuple[str, ...] = ()
    weight: str = ""

    def value(self, name: str) -> Unknown:
        """Return the unknown of this name, e.g. ``gain[0]``.

        Raises:
            KeyError: it was not fitted.
        """
        return {unknown.name: unknown for unknown in self.unknowns}[name]

    def text(self) -> str:
        """Return the report as text for people."""
        lines = [
            f"Calibration from {self.source or 'a log'}: {self.duration:.0f} s, {self.rows} rows",
            "",
            f"{'unknown':26s} {'value':>12s} {'std':>10s}  unit",
        ]
        for item in self.unknowns:
            factor, unit = readable(item.unit)
            note = "  the data hardly tell it" if item.untold else ""
            note += "  at its bound" if item.at_bound else ""
            if item.name.startswith("log_"):
                note = f"  {math.exp(item.value):.3f} × the prior's{note}"
            value, deviation = factor * item.value, factor * item.deviation
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
        lines += filter(None, [self.weight])
        late, deviation = self.delay
        if late < -3.0 * deviation:
            lines.append(
                f"what was seen is {-1e3 * late:.0f} ± {1e3 * deviation:.0f} ms early, as no "
                "camera is: friction may pass for some of it; check clocks, mass and lengths"
            )
        if late > 3.0 * deviation:
            lines.append(
                f"what was seen is {1e3 * late:.0f} ± {1e3 * deviation:.0f} ms late: the trackers' "
                f"parameter sensor_delay takes {late:.3f} s off their stamps. The fit is without "
                f"{1e3 * self.taken_out:.0f} ms of it"
            )
        for i, j in np.argwhere(np.tril(np.abs(self.correlation) > STRONG, -1)):
            lines.append(
                f"the log cannot tell {self.unknowns[i].name} and {self.unknowns[j].name} apart "
                f"(correlation {self.correlation[i, j]:+.2f})"
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
        geometry, limb = self.geometry, self.geometry.limb
        lengths = ", ".join(
            f"{1e3 * segment.length:.1f} ± {1e3 * deviation:.1f}"
            for segment, deviation in zip(limb.segments, geometry.uncertainty, strict=False)
        )
        return [
            f"lengths: {lengths} mm, connector {1e3 * limb.connector_length:.1f} mm, stiff base "
            f"{1e3 * limb.base_length:.1f} mm; tips within "
            f"{1e3 * geometry.residual:.2f} mm of an evenly bent rod at the measured angles "
            f"(with the prior's lengths {1e3 * geometry.residual_before:.2f} mm)"
        ]

    def _load_lines(self) -> list[str]:
        limb = self.limb
        if not limb.weighs_in_plane:
            return []
        lever = weight_of(replace(limb, gravity=(0.0, 1.0, 0.0))).lever
        moment = float(lever.sum()) + limb.base_length * limb.moving_mass
        line = (
            f"loads: gravity of {math.hypot(*limb.gravity[:2]):.2f} m/s² in the plane pulls at "
            f"{1e3 * limb.moving_mass:.0f} g beyond the base, first moment {1e3 * moment:.1f} g·m "
            "about the clamp"
        )
        return [
            line,
            "loads: stiffness, gain and mass scale together, so that one of them was given",
            f"loads: the limb was made straight, its rest angles are 0 ± "
            f"{math.degrees(REST_SPREAD):.0f}° but for what the log tells",
        ]


def readable(unit: str) -> tuple[float, str]:
    """Return the factor to a unit as people read it, degrees and hPa, and its name."""
    return {
        "rad/Pa": (math.degrees(1.0) * 100.0, "deg/hPa"),
        "rad": (math.degrees(1.0), "deg"),
        "1/Pa": (1e6, "% per 10 kPa"),
        "1/rad²": (100.0 * math.radians(45.0) ** 2, "% at 45 deg"),
        "Pa": (0.01, "hPa"),
        "Pa/rad": (0.01 * math.radians(45.0), "hPa at 45 deg"),
    }.get(unit, (1.0, unit))


def predict(limb: Limb, time: Array, differential_pressure: Array, model: str = "der") -> Response:
    """Predict the bend of a limb from the pressures in its chambers.

    Args:
        limb: calibrated limb.
        time: (K,) regular [s].
        differential_pressure: (K, M) measured [Pa], without gaps.
        model: ``der`` or ``pcc``.

    Returns:
        Bend angles (K, M) [rad] and tips (K, 2) [m] at ``time`` among others, from the equilibrium
        of the first pressures on. Measured angles are not used.

    Raises:
        LogError: the model cannot follow the pressures, or does not come to rest.
    """
    try:
        return simulate(Model.of(limb, model), time, pressures=differential_pressure)
    except RuntimeError as error:
        raise LogError(
            f"the {model} model of the limb '{limb.name}' cannot follow this log ({error}): check "
            "that the limb file is that of this limb, with its mounting and what it carries"
        ) from error


@dataclass(frozen=True)
class Check:
    """How a limb file does on a later run.

    Attributes:
        fits: the limb need not be calibrated again.
        findings: sentences; empty where all is well.
        error: (M,) root mean square open-loop error of the bend angles [rad].
        tip_error: mean distance of the tips that were measured and those that the measured
            pressures, and the commands, let expect (2,) [m]; NaN without tips.
        gain_change: (M,) measured over predicted range of motion, less one; NaN for a segment that
            hardly moved.
        rest_change: (M,) mean of measured less predicted, at the gain that fits best [rad].
    """

    fits: bool
    findings: tuple[str, ...]
    error: Array
    tip_error: Array
    gain_change: Array
    rest_change: Array

    def text(self) -> str:
        """Return the verdict for people."""
        lines = []
        for index, (error, gain, rest) in enumerate(
            zip(self.error, self.gain_change, self.rest_change, strict=True)
        ):
            change = f"{100 * gain:+.1f} %" if math.isfinite(gain) else "not shown"
            lines.append(
                f"segment {index}: open-loop error rms {math.degrees(error):.2f}°, gain "
                f"{change}, rest angle {math.degrees(rest):+.2f}°"
            )
        if np.isfinite(self.tip_error).all():
            held, asked = 1e3 * self.tip_error
            lines.append(
                f"tip: mean error {held:.2f} mm by the measured pressures, {asked:.2f} mm by the "
                "commands: what is between them is of board, sensors and air"
            )
        lines += [f"finding: {text}" for text in self.findings]
        lines.append(
            "the limb file fits" if self.fits else "the limb file does not fit: calibrate again"
        )
        return "\n".join(lines)


def check(limb: Limb, log: CalibrationLog) -> Check:
    """Compare a limb file with a later run.

    Raises:
        LogError: the log cannot be used, see `prepare`, or the limb's rod cannot follow it.
    """
    prepared = prepare(log, limb, to_fit=False)
    rows = prepared.usable
    predicted = predict(limb, prepared.log.time, prepared.pressure)
    measured = prepared.log.bend_angles
    error = np.sqrt(np.nanmean((measured - predicted.bend_angles) ** 2, axis=0))
    gains, rests, drift = np.full(len(error), math.nan), np.empty(len(error)), list[str]()
    before = limb.provenance.get("residual_deg") or [0.0] * len(error)
    for index in range(len(error)):
        expected, seen = predicted.bend_angles[rows, index], measured[rows, index]
        rests[index] = np.mean(seen - expected)
        if np.ptp(expected) >= LEAST_MOTION:
            slope, rests[index] = np.polyfit(expected, seen, 1)
            gains[index] = slope - 1.0
        if abs(gains[index]) > GAIN_DRIFT:
            drift.append(f"the gain of segment {index} changed by {100 * gains[index]:+.0f} %")
        if abs(rests[index]) > REST_DRIFT:
            drift.append(
                f"the rest angle of segment {index} moved by {math.degrees(rests[index]):+.1f}°"
            )
        usual = max(LEAST_ERROR, math.radians(float(before[index])))
        if error[index] > ERROR_GROWTH * usual:
            drift.append(
                f"the error of segment {index} is {math.degrees(error[index]):.2f}°, at its "
                f"calibration it was {math.degrees(usual):.2f}°"
            )
    asked, tip = prepared.log.commanded_differential, prepared.log.tip
    asked = np.where(np.isfinite(asked), asked, prepared.pressure)
    held = Air(limb.pneumatics).pressures_at_commands(asked, CONTROL_PERIOD)
    expected_tips = np.stack([predicted.tip, predict(limb, prepared.log.time, held).tip])
    distance = np.linalg.norm(tip - expected_tips, axis=2)
    tip_error = np.nanmean(distance, axis=1) if np.isfinite(tip).any() else np.full(2, math.nan)
    return Check(not drift, (*prepared.warnings, *drift), error, tip_error, gains, rests)


def plot_prediction(
    limb: Limb, log: CalibrationLog, path: str | Path, held_out: CalibrationLog | None = None
) -> None:
    """Write a figure of bend angles, measured and predicted open loop, with the errors below.

    Args:
        limb: identified.
        log: that it was fitted to.
        path: of the PNG.
        held_out: a log that the fit has not seen.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415

    logs = [("fitted", log)] + ([("not seen by the fit", held_out)] if held_out else [])
    figure = Figure(figsize=(5.2 * len(logs), 4.2), layout="constrained")
    axes = figure.subplots(2, len(logs), sharex="col", squeeze=False, height_ratios=(2, 1))
    for column, (title, one) in enumerate(logs):
        grid = one.resampled(CONTROL_PERIOD)
        predicted = predict(limb, grid.time, bridge(grid.measured_differential)).bend_angles
        top, bottom = axes[0, column], axes[1, column]
        for index in range(limb.segment_count):
            colour = f"C{index}"
            measured = np.degrees(grid.bend_angles[:, index])
            model = np.degrees(predicted[:, index])
            top.plot(grid.time, measured, colour, lw=1.2, label=f"segment {index}, measured")
            top.plot(grid.time, model, "k--", lw=0.8, label="predicted" if index == 0 else None)
            bottom.plot(grid.time, measured - model, colour, lw=0.8)
        top.set_title(title)
        top.legend(fontsize=7)
        bottom.set_xlabel("time [s]")
    axes[0, 0].set_ylabel("bend angle [deg]")
    axes[1, 0].set_ylabel("error [deg]")
    figure.savefig(path, dpi=80)
