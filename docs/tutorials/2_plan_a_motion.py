"""
Plan a motion, then a path of your own
======================================

From what the tip should do to the pressures that make it, and what stands in the way: reach,
pressure, and how fast air flows.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from der_planner.limb import Limb
from der_planner.model import Model
from der_planner.planning import Motion, UnreachableError, plan
from der_planner.twin.offline import play

limb = Limb.default()  # another: limb.to_yaml("mine.yaml"), edit, Limb.from_yaml("mine.yaml")
print(f"{limb.segment_count} segments, {100 * limb.length:.1f} cm")

# %%
# A motion with a name
# --------------------

eight = plan(limb, Motion.named("figure_eight", cycles=1))
print(f"{len(eight.time)} setpoints, one every 50 ms, planned in {eight.solve_time:.1f} s")
print(f"predicted error of the tip {1e3 * eight.predicted_error:.2f} mm")


def draw(made, title):
    """Draw the path with the limb at some instants, and the pressures beside it."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6))
    for index in np.linspace(0, len(made.time) - 1, 9).astype(int):
        left.plot(*made.curve(index).T, color="0.8")
    left.plot(*made.tip_reference.T, label="asked for")
    left.plot(*made.tip_predicted.T, "--", label="predicted")
    left.axis("equal")
    left.set(xlabel="x [m]", ylabel="y [m]", title=title)
    left.legend()
    right.plot(made.time, 1e-3 * made.differential_pressure)
    right.set(xlabel="time [s]", ylabel="differential pressure [kPa]")
    figure.tight_layout()


draw(eight, "figure eight")

# %%
# A path of your own
# ------------------
# Points in the limb's frame: the clamp is the origin, x runs along the straight limb. Without times
# the tip goes at 3 cm/s at most. A path is either in reach or refused, with the place.

square = np.array([[0.20, 0.08], [0.22, 0.08], [0.22, 0.10], [0.20, 0.10], [0.20, 0.08]])
try:
    plan(limb, Motion.from_tip_path(None, square + [0.03, 0.03]))
except UnreachableError as error:
    print("refused:", error)

# %%
# ``nearest`` follows the nearest path that the limb can follow, and says how far off that is.

made = plan(limb, Motion.from_tip_path(None, square, name="square", nearest=True))
print("\n".join(made.warnings) or "no warnings")
draw(made, "square")

# %%
# What limits it
# --------------
# Chambers fill at some 9 kPa/s and vent more slowly. The same motion at a shorter period costs more
# of them, until the tip cannot keep up: the plan's warnings say so before anything moves.

for period in (20.0, 6.0, 3.0):
    fast = plan(limb, Motion.named("same_direction", period=period, cycles=1))
    slope = np.abs(np.diff(fast.differential_pressure, axis=0)).max() / 0.05
    largest = np.abs(fast.differential_pressure).max()
    print(
        f"{period:4.0f} s: error {1e3 * fast.predicted_error:5.2f} mm, largest {1e-3 * largest:.1f} kPa, "
        f"steepest {1e-3 * slope:.0f} kPa/s; {'; '.join(fast.warnings) or 'no warnings'}"
    )
    assert largest <= limb.pneumatics.pressure_limit

# %%
# Does the limb do it?
# --------------------
# The twin of seed 3 is a limb of another rod library, whose limb file comes from a calibration run. The
# same path is planned for that limb and played on it: the planned limb beside the one that moves.

folder = Path("docs/tutorials") if Path("docs/tutorials").is_dir() else Path()
known = Limb.from_yaml(folder / "seed_3.yaml")
ours = plan(known, Motion.from_tip_path(None, square, name="square", nearest=True))
moved = play(ours.time, ours.differential_pressure, seed=3)
error = np.linalg.norm(moved.tip - ours.tip_reference, axis=1).mean()
print(f"mean error of the tip {1e3 * error:.2f} mm")

plt.figure()
for index in np.linspace(0, len(ours.time) - 1, 5).astype(int):
    plt.plot(*ours.curve(index).T, "C0--", label="planned")
    plt.plot(*Model.of(known).kinematics.curve(moved.bend_angles[index]).T, "C1", label="twin")
plt.plot(*moved.tip.T, "C1", lw=1)
plt.legend(*(each[:2] for each in plt.gca().get_legend_handles_labels()))
plt.axis("equal")
plt.show()

# %%
# ``write_plan(made, "square.yaml")`` of ``der_planner.planning.plan_file`` keeps the plan. On the graph the same path is
# ``python3 scripts/run_experiment.py --path my_path.csv --nearest``.
