"""Draw a twin and both models of it under held pressures, for the page on loads.

python3 scripts/draw_figures.py loads
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from der_planner.limb import Limb
from der_planner.model import ArcModel, Model, simulate
from der_planner.model.air import pair_of
from der_planner.rod import RodState
from der_planner.studies.tasks import Twin, calibrated, limb_of
from der_planner.twin import LimbTwin
from der_planner.twin.limb_twin import ATMOSPHERE
from figures.drawing import FOLDER, save

MODELS = ("der", "pcc")
MOUNTINGS = ("hanging", "sideways")
PAYLOADS = (0.0, 0.05)
HELD = ((0.0, 0.0), (10e3, 0.0), (8e3, 8e3), (10e3, -10e3))
"""Differential pressures that are held [Pa]."""
HOLD = 8.0
"""For so long [s]."""
COLORS = {"truth": "k", "der": "tab:green", "pcc": "tab:orange"}
LABELS = {"truth": "twin", "der": "DER", "pcc": "PCC"}

Array = NDArray[np.float64]


def true_shape(seed: int, limb: Limb, pressure: Array) -> Array:
    """Return the twin's centreline (P, 2) [m] after `HOLD` under pressures (M,) [Pa]."""
    twin = LimbTwin(seed, gravity=limb.gravity, masses=limb.masses)
    # Filled over 2 s, as a board would: a jump makes the limb swing past its friction.
    for share in np.minimum(np.arange(0.05, HOLD, 0.05) / 2.0, 1.0):
        twin.step(ATMOSPHERE + share * pair_of(pressure).ravel(), 0.05)
    return twin.shape().points


def model_shape(limb: Limb, model: str, pressure: Array) -> Array:
    """Return the centreline (P, 2) [m] that a model expects of the same."""
    time = np.arange(0.0, HOLD, 0.05)
    held = np.minimum(time / 2.0, 1.0)[:, None] * pressure
    seen = limb.for_model(model)
    final = simulate(Model.of(seen, model), time, pressures=held).final
    if isinstance(final, RodState):
        return np.stack([final.q[0::4], final.q[1::4]], axis=1)
    return ArcModel(seen).curve(final.angles)


def draw_shapes(path: Path, seed: int) -> None:
    """Draw the twin and both models of it under held pressures."""
    figure, axes = plt.subplots(1, 4, figsize=(13, 3.8), layout="constrained")
    cases = [(mounting, payload) for mounting in MOUNTINGS for payload in PAYLOADS]
    for axis, (mounting, payload) in zip(axes, cases, strict=True):
        limb = limb_of(calibrated(Twin(seed, mounting=mounting), "")).carrying(payload)
        for held in HELD:
            pressure = np.array(held)
            shapes = {"truth": true_shape(seed, limb, pressure)}
            shapes |= {model: model_shape(limb, model, pressure) for model in MODELS}
            for name, points in shapes.items():
                width = 3.0 if name == "truth" else 1.3
                label = LABELS[name] if held == HELD[0] else None
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
    save(figure, path, 80)


def main() -> int:
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seed", type=int, default=106, help="twin of the shapes")
    given = parser.parse_args()
    draw_shapes(FOLDER / "loads_shapes.png", given.seed)
    return 0
