"""Open-loop prediction of a run against what was measured: numbers, a figure, and a verdict.

The verdict says whether a limb file still fits a later run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from der_planner.arrays import Array
from der_planner.identification.log import CalibrationLog, LogError, bridge, prepare
from der_planner.limb import Limb
from der_planner.model import CONTROL_PERIOD, Model, simulate

GAIN_DRIFT = 0.08
"""Relative change of a gain above which the limb must be calibrated again."""
REST_DRIFT = math.radians(1.5)
"""Change of a rest angle above which the limb must be calibrated again [rad]."""
ERROR_GROWTH = 2.5
"""Error over the calibration's own error above which the limb must be calibrated again."""
LEAST_ERROR = math.radians(0.4)
LEAST_MOTION = math.radians(3.0)
"""Predicted range of motion above which the gain is checked [rad]."""


@dataclass(frozen=True)
class Prediction:
    """An open-loop prediction.

    Attributes:
        bend_angles: (K, M) [rad].
        tip: (K, 2) [m].
    """

    bend_angles: Array
    tip: Array


def predict(
    limb: Limb,
    time: Array,
    differential_pressure: Array,
    model: str = "der",
) -> Prediction:
    """Predict the bend of a limb from the pressures in its chambers.

    Args:
        limb: calibrated limb.
        time: (K,) regular [s].
        differential_pressure: (K, M) measured [Pa], without gaps.
        model: ``der`` or ``pcc``.

    Returns:
        Bend angles and tips at ``time``, from the equilibrium of the first pressures on. Measured
        angles are not used.

    Raises:
        LogError: the model cannot follow the pressures, or does not come to rest.
    """
    try:
        response = simulate(Model.of(limb, model), time, pressures=differential_pressure)
    except RuntimeError as error:
        raise LogError(
            f"the {model} model of the limb '{limb.name}' cannot follow this log ({error}): check "
            "that the limb file is that of this limb, with its mounting and what it carries"
        ) from error
    return Prediction(response.bend_angles, response.tip)


@dataclass(frozen=True)
class Check:
    """How a limb file does on a later run.

    Attributes:
        fits: the limb need not be calibrated again.
        findings: sentences; empty where all is well.
        error: (M,) root mean square open-loop error of the bend angles [rad].
        tip_error: mean distance of predicted and measured tips [m]; NaN without tips.
        gain_change: (M,) measured over predicted range of motion, less one; NaN for a segment that
            hardly moved.
        rest_change: (M,) mean of measured less predicted, at the gain that fits best [rad].
    """

    fits: bool
    findings: tuple[str, ...]
    error: Array
    tip_error: float
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
        if math.isfinite(self.tip_error):
            lines.append(f"tip: mean error {1e3 * self.tip_error:.2f} mm")
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
    gains, rests = np.empty(len(error)), np.empty(len(error))
    still: list[str] = []
    for index in range(len(error)):
        expected, seen = predicted.bend_angles[rows, index], measured[rows, index]
        if np.ptp(expected) < LEAST_MOTION:
            gains[index], rests[index] = math.nan, np.mean(seen - expected)
            still.append(f"segment {index} hardly moved in this run: its gain is not checked")
            continue
        slope, offset = np.polyfit(expected, seen, 1)
        gains[index], rests[index] = slope - 1.0, offset
    distance = np.linalg.norm(prepared.log.tip - predicted.tip, axis=1)
    tip_error = float(np.nanmean(distance)) if np.isfinite(distance).any() else math.nan
    findings = [*prepared.warnings, *_drift(limb, error, gains, rests)]
    drifted = len(findings) > len(prepared.warnings)
    findings += still + _range(limb, prepared.pressure[rows], bridge(measured))
    return Check(not drifted, tuple(findings), error, tip_error, gains, rests)


def _drift(limb: Limb, error: Array, gains: Array, rests: Array) -> list[str]:
    found = []
    before = limb.provenance.get("residual_deg") or [0.0] * len(error)
    for index in range(len(error)):
        if abs(gains[index]) > GAIN_DRIFT:
            found.append(f"the gain of segment {index} changed by {100 * gains[index]:+.0f} %")
        if abs(rests[index]) > REST_DRIFT:
            found.append(
                f"the rest angle of segment {index} moved by {math.degrees(rests[index]):+.1f}°"
            )
        usual = max(LEAST_ERROR, math.radians(float(before[index])))
        if error[index] > ERROR_GROWTH * usual:
            found.append(
                f"the error of segment {index} is {math.degrees(error[index]):.2f}°, at its "
                f"calibration it was {math.degrees(usual):.2f}°"
            )
    return found


def _range(limb: Limb, pressure: Array, bend: Array) -> list[str]:
    found = []
    for values, known, name, unit, factor in (
        (pressure, limb.calibrated.differential_pressure, "pressure", "hPa", 0.01),
        (bend, limb.calibrated.bend_angle, "bend", "°", math.degrees(1.0)),
    ):
        if len(known) != limb.segment_count:
            continue
        for index, (largest, limit) in enumerate(
            zip(np.abs(values).max(axis=0), known, strict=True)
        ):
            if largest > 1.05 * limit:
                found.append(
                    f"the {name} of segment {index} reaches {factor * largest:.0f} {unit}, "
                    f"calibrated "
                    f"were {factor * limit:.0f} {unit}"
                )
    return found


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
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    logs = [("fitted", log)] + ([("not seen by the fit", held_out)] if held_out else [])
    figure = Figure(figsize=(5.2 * len(logs), 4.2), layout="constrained")
    FigureCanvasAgg(figure)
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
