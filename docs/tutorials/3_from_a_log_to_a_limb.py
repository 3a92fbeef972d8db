"""
From a log to a limb: identify, check, predict
==============================================

A limb is known by a run that moves it: pressures in, bend angles and tip out. Here the twin, a rod of
another library with friction, creep and unequal chambers, stands in for the hardware. A log of your own
is read by ``read_csv(FILE, ColumnMap.from_yaml(MAP))`` or ``read_bag`` instead, and the rest is the same.
"""

import matplotlib.pyplot as plt
import numpy as np

from der_planner.identification import check, fit, predict, record_twin
from der_planner.identification.excitation import Excitation, calibration_run, waves
from der_planner.limb import Limb
from der_planner.model import Model

SEED = 3  # each seed is another limb

prior = Limb.default()
excitation = calibration_run(0.7 * prior.pneumatics.pressure_limit, quick=True)
log = record_twin(SEED, excitation)
print(f"{log.time[-1]:.0f} s, {log.time.size} rows of {log.source}")

# %%
# Identify
# --------
# Every number comes with its standard deviation, and the report says what the log hardly tells.

limb, report = fit(prior, log)
print(report.text())

# %%
# The numbers with their uncertainties, as multiples of the deviation beside what was assumed before:

for name in ("gain[0]", "gain[1]", "friction_pressure[0]", "friction_pressure[1]"):
    item = report.value(name)
    print(f"{name:12s} {item.value:.3g} ± {item.deviation:.2g} {item.unit}")

# %%
# Predict
# -------
# The test of a model is a run that it was not fitted to: from the measured pressures alone, open loop,
# for its whole length. Another run of the same limb begins with other rest angles.

pressure = waves(0.5 * prior.pneumatics.pressure_limit, prior.segment_count, 30.0)
later = record_twin(SEED, Excitation(pressure), run=7)
even = later.resampled(0.05)
known = predict(limb, even.time, even.measured_differential)
before = predict(prior, even.time, even.measured_differential)

figure, axes = plt.subplots(2, 1, sharex=True, figsize=(9, 5))
for index, axis in enumerate(axes):
    axis.plot(even.time, np.rad2deg(even.bend_angles[:, index]), "0.6", lw=3, label="measured")
    axis.plot(before.time, np.rad2deg(before.bend_angles[:, index]), ":", label="before the fit")
    axis.plot(known.time, np.rad2deg(known.bend_angles[:, index]), label="identified")
    axis.set_ylabel(f"bend of segment {index} [°]")
axes[0].legend(loc="upper right")
axes[1].set_xlabel("time [s]")
figure.tight_layout()

body = Model.of(limb).kinematics
plt.figure()
for row in np.linspace(0, len(even.time) - 1, 8).astype(int):
    plt.plot(*body.curve(even.bend_angles[row]).T, "0.6", lw=3, label="measured")
    plt.plot(*body.curve(known.bend_angles[row]).T, "C1", label="predicted")
plt.legend(*(each[:2] for each in plt.gca().get_legend_handles_labels()))
plt.axis("equal")

# %%
# Check
# -----
# ``check`` says in words whether the limb file still fits; ``update`` brings it up to date from ordinary
# runs. From the command line: ``scripts/calibrate_limb.py`` and ``scripts/check_limb.py``.

verdict = check(limb, later)
print(verdict.text())
assert verdict.error.max() < np.deg2rad(4.0)

plt.show()

# %%
# ``limb.to_yaml("my_limb.yaml")`` keeps it, for ``plan``, ``run_experiment.py --limb`` and the planner node.
