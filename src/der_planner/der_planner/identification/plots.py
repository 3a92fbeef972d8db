"""Figures of a calibration: bend angles measured and predicted, and the difference."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from der_planner.identification.logs.log import CalibrationLog
from der_planner.identification.logs.prepare import bridge
from der_planner.identification.predict import predict
from der_planner.limb import Limb
from der_planner.model.series import CONTROL_PERIOD


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
        pressure = np.stack([bridge(part) for part in grid.measured_differential.T], axis=1)
        predicted = predict(limb, grid.time, pressure).bend_angles
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
