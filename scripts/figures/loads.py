"""Draw the pictures of the page on rod and arcs under loads, from the rows and limbs of the study.

python3 scripts/benchmark.py loads          # first: plays what the rows lack
python3 scripts/draw_figures.py loads
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from benchmarks.loads import MODELS, STUDY_SEEDS, calibrated, comparisons, read_rows
from der_planner.limb import Limb
from der_planner.model.air import pair_of
from der_planner.model import ArcModel
from der_planner.model import simulate
from der_planner.rod import RodState
from der_planner.twin import LimbTwin
from der_planner.twin.limb_twin import ATMOSPHERE
from workspace_setup.basics import ROOT

matplotlib.use("Agg")

DPI = 80
FOLDER = ROOT / "src" / "der_planner" / "doc"
MOUNTINGS = ("hanging", "sideways")
PAYLOADS = (0.0, 0.05)
HELD = ((0.0, 0.0), (10e3, 0.0), (8e3, 8e3), (10e3, -10e3))
"""Differential pressures that are held [Pa]."""
HOLD = 8.0
"""For so long [s]."""
COLORS = {"truth": "k", "der": "tab:green", "pcc": "tab:orange"}

Array = NDArray[np.float64]


def true_shape(seed: int, limb: Limb, pressure: Array) -> Array:
    """Return the twin's centreline (P, 2) [m] after `HOLD` under pressures (M,) [Pa]."""
    twin = LimbTwin(seed, gravity=limb.gravity, masses=limb.masses)
    # Filled over 2 s, as a board would: a jump makes the limb swing past its friction.
    for share in np.minimum(np.arange(0.05, HOLD, 0.05) / 2.0, 1.0):
        twin.step(ATMOSPHERE + share * pair_of(pressure).ravel(), 0.05)
    return twin.shape(101).points


def model_shape(limb: Limb, model: str, pressure: Array) -> Array:
    """Return the centreline (P, 2) [m] that a model expects of the same."""
    time = np.arange(0.0, HOLD, 0.05)
    held = np.minimum(time / 2.0, 1.0)[:, None] * pressure
    seen = limb.for_model(model)
    final = simulate(seen, time, pressures=held, model=model).final
    if isinstance(final, RodState):
        return np.stack([final.q[0::4], final.q[1::4]], axis=1)
    return ArcModel(seen).curve(final.angles)


def draw_shapes(path: Path, seed: int) -> None:
    """Draw the twin and both models of it under held pressures."""
    figure, axes = plt.subplots(1, 4, figsize=(13, 3.8), layout="constrained")
    cases = [(mounting, payload) for mounting in MOUNTINGS for payload in PAYLOADS]
    for axis, (mounting, payload) in zip(axes, cases, strict=True):
        limb = calibrated(seed, mounting).carrying(payload)
        for held in HELD:
            pressure = np.array(held)
            shapes = {"truth": true_shape(seed, limb, pressure)}
            shapes |= {model: model_shape(limb, model, pressure) for model in MODELS}
            for name, points in shapes.items():
                width = 3.0 if name == "truth" else 1.3
                label = name.upper() if held == HELD[0] and name != "truth" else None
                label = "twin" if held == HELD[0] and name == "truth" else label
                axis.plot(*(points.T * 100), color=COLORS[name], lw=width, label=label,
                          alpha=0.35 if name == "truth" else 1.0)  # fmt: skip
            apart = {
                model: np.linalg.norm(shapes[model][-1] - shapes["truth"][-1]) for model in MODELS
            }
            said = ", ".join(f"{model} {gap * 1000:.1f} mm" for model, gap in apart.items())
            print(f"  {mounting}, {payload * 1000:.0f} g, {held} Pa: tip off by {said}")
        axis.set(title=f"{mounting}, {payload * 1000:.0f} g", xlabel="x [cm]", aspect="equal")
    axes[0].set_ylabel("y [cm]")
    axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=DPI)
    plt.close(figure)


def draw_errors(path: Path) -> None:
    """Draw the mean errors of both models over the payload, one panel a mounting."""
    found = comparisons(read_rows())
    mountings = list(dict.fromkeys(row.mounting for row, *_ in found))
    figure, axes = plt.subplots(
        1, len(mountings), figsize=(3.2 * len(mountings), 3), layout="constrained", squeeze=False,
        sharex=True, sharey=True,
    )  # fmt: skip
    for axis, mounting in zip(axes[0], mountings, strict=True):
        for period, style in ((20.0, "-o"), (6.0, "--s")):
            of_panel = sorted(
                (row.payload_kg, rows) for row, rows, _ in found
                if (row.mounting, row.period_s) == (mounting, period)
            )  # fmt: skip
            for model in MODELS:
                _draw_line(axis, of_panel, model, style, f"{model.upper()}, {period:.0f} s")
        title = f"tilted by {mounting}°" if mounting.isdigit() else mounting
        axis.set(title=title, xlabel="payload [g]", yscale="log")
    axes[0, 0].set_ylabel("mean tip error [cm]")
    axes[0, 0].legend(fontsize=7)
    figure.savefig(path, dpi=DPI)
    plt.close(figure)


def _draw_line(axis: Axes, of_panel: list, model: str, style: str, label: str) -> None:
    payloads, means = [], []
    for payload, rows in of_panel:
        errors = [r.mean_error_m * 100 for r in rows if r.model == model and not r.refused]
        if errors:
            payloads.append(payload * 1000)
            means.append(np.mean(errors))
            axis.plot([payload * 1000] * len(errors), errors, ".", color=COLORS[model], alpha=0.4)
    axis.plot(payloads, means, style, color=COLORS[model], label=label, ms=4, lw=1)


def main() -> int:
    """Draw both."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seed", type=int, default=STUDY_SEEDS[0], help="twin of the shapes")
    given = parser.parse_args()
    draw_shapes(FOLDER / "loads_shapes.png", given.seed)
    draw_errors(FOLDER / "loads_errors.png")
    return 0
