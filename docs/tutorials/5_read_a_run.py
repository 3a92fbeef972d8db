"""
Read a recorded run: errors, friction, a figure of your own
===========================================================

A run's bag holds every topic. Here is a small one: the twin of seed 3 played a figure eight, and only four
topics were kept, with every third picture. Its limb file is the one that was identified before the run. Give a bag of
yours instead: the rest is the same.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from der_planner.limb import Limb
from der_planner.model import Material, Model
from der_planner.planning import Motion, plan
from der_planner.results import evaluate_run, format_table, load_run, summarise

folder = Path("docs/tutorials") if Path("docs/tutorials").is_dir() else Path()
run = load_run(folder / "figure_eight.mcap")
print(run.description.motion, run.description.model, run.description.method, run.description.bag)

# %%
# Everything is on one clock, which is 0 at the first setpoint: ``run.tip``, ``run.bend_angle``, ``run.measured``
# and the others have a ``time`` and a ``value``.

print(f"{len(run.tip)} pictures, {len(run.measured)} pressures, {len(run.setpoints)} setpoints")

# %%
# Errors
# ------
# The numbers of ``results.json``: distances of the tip, as the camera saw it, from where it should have been
# at that instant.

result = evaluate_run(run)
print(format_table(summarise([result])))

reference = np.stack([np.interp(run.tip.time, run.reference.time, c) for c in run.reference.value.T], 1)
error = np.linalg.norm(run.tip.value - reference, axis=1)
during = (run.tip.time >= 0) & (run.tip.time <= run.reference.time[-1])

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6))
left.plot(*run.reference.value.T, "k--", lw=1, label="asked for")
left.plot(*run.predicted.value.T, label="planned")
left.plot(*run.tip.value[during].T, label="filmed")
left.axis("equal")
left.set(xlabel="x [m]", ylabel="y [m]")
left.legend()
right.plot(run.tip.time[during], 1e3 * error[during])
right.set(xlabel="time [s]", ylabel="error of the tip [mm]")
figure.tight_layout()

# %%
# Friction
# --------
# The same pressure holds another bend on the way up than on the way down. The identified material says how
# much pressure friction and creep take along the bend that was filmed.

limb = Limb.from_yaml(folder / "seed_3.yaml")
seen = during & np.isfinite(run.bend_angle.value).all(axis=1)
time, bend = run.bend_angle.time[seen], run.bend_angle.value[seen]
taken = Material(limb).memory_pressures(time, bend)
pressure = np.stack([np.interp(time, run.measured.time, c) for c in run.measured.value.T], axis=1)

figure, axes = plt.subplots(1, 2, figsize=(9, 3.6))
for index, axis in enumerate(axes):
    axis.plot(1e-3 * pressure[:, index], np.rad2deg(bend[:, index]), label="as measured")
    axis.plot(1e-3 * (pressure - taken)[:, index], np.rad2deg(bend[:, index]), label="less friction, creep")
    axis.set(xlabel="differential pressure [kPa]", ylabel="bend [°]", title=f"segment {index}")
axes[0].legend()
figure.tight_layout()
print("friction and creep take up to", np.abs(taken).max(axis=0).round(), "Pa")

# %%
# A figure of your own
# --------------------
# Shapes come from bend angles: here the limb as filmed beside the limb as planned, at four instants.

told = run.description
planned = plan(limb, Motion.named(told.motion, told.amplitude, told.period, told.cycles))
body = Model.of(limb).kinematics
plt.figure()
for instant in np.linspace(5, 30, 4):
    plt.plot(*planned.curve(np.searchsorted(planned.time, instant)).T, "C0--", label="planned")
    plt.plot(*body.curve(bend[np.searchsorted(time, instant)]).T, "C1", label="filmed")
plt.legend(*(each[:2] for each in plt.gca().get_legend_handles_labels()))
plt.axis("equal")
plt.xlabel("x [m]")
plt.ylabel("y [m]")
plt.show()

# %%
# From the command line: ``python3 scripts/evaluate.py BAG --report DIR``.

assert result.mean_error_m < 0.01
