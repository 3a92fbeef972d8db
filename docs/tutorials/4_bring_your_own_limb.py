"""
Bring your own limb: any simulator, in forty lines
==================================================

Planner, learning and feedback need very little of a limb: pressures go in, and the tip and the bend angles
of its segments come out. This tutorial puts another simulator behind them: a chain of links in MuJoCo, where
it is installed (``pip install mujoco``; the project does not need it), else the same chain written in numpy.
MuJoCo 4.0.0 gave mean errors of 2.96, 0.60 and 0.04 mm, and 1.52 mm with feedback, by ``python3
scripts/workspace.py exec PYTHON docs/tutorials/4_bring_your_own_limb.py``, with the PYTHON of an environment
that adds MuJoCo to ``.venv``.
"""

import matplotlib.pyplot as plt
import numpy as np

from der_planner.control import Feedback, Learner
from der_planner.control.lockstep import Sensors, play
from der_planner.identification import CalibrationLog, fit
from der_planner.identification.excitation import calibration_run
from der_planner.limb import Limb
from der_planner.model import Model
from der_planner.planning import Motion, plan

try:
    import mujoco
except ImportError:
    mujoco = None

JOINTS, LENGTH, MASS = 8, 0.244, 0.26  # per segment four joints; [m], [kg]
STIFFNESS, DAMPING, COUPLE = 0.55, 0.012, 1.1e-5  # [N·m/rad], [N·m·s/rad], [N·m/Pa] of each joint
LINK, LAG, STEP = LENGTH / JOINTS, 0.25, 5e-3  # [m], of the air [s], [s]


# %%
# The simulator
# -------------
# Nothing here knows the project. Both chains have links with a mass at the far end, springs and dampers in
# the joints, and a couple in the joints of a segment that is proportional to its pressure.


class NumpyChain:
    """A chain of point masses on rigid links, by the semi-implicit Euler rule."""

    def __init__(self):
        self.joint, self.rate = np.zeros(JOINTS), np.zeros(JOINTS)

    def step(self, couple):
        """Advance by ``STEP`` under couples (JOINTS,) [N·m]."""
        heading = np.cumsum(self.joint)
        links = LINK * np.stack([-np.sin(heading), np.cos(heading)])  # d(link)/d(heading)
        moves = np.tril(np.ones((JOINTS, JOINTS)))
        jacobian = np.einsum("cl,pl,lj->cpj", links, moves, moves).reshape(-1, JOINTS)
        inertia = MASS / JOINTS * jacobian.T @ jacobian + 2e-6 * np.eye(JOINTS)
        soft = inertia + np.eye(JOINTS) * (STEP * DAMPING + STEP**2 * STIFFNESS)
        force = couple - STIFFNESS * (self.joint + STEP * self.rate) - DAMPING * self.rate
        self.rate = self.rate + np.linalg.solve(soft, STEP * force)
        self.joint = self.joint + STEP * self.rate


class MujocoChain:
    """The same chain in MuJoCo."""

    def __init__(self):
        body = "".join(
            f'<body pos="{LINK * (i > 0)} 0 0"><joint type="hinge" axis="0 0 1" stiffness="{STIFFNESS}" '
            f'damping="{DAMPING}" armature="2e-6"/><geom type="sphere" size="0.004" pos="{LINK} 0 0" '
            f'mass="{MASS / JOINTS}" contype="0" conaffinity="0"/>'
            for i in range(JOINTS)
        )
        options = f'<option timestep="{STEP}" gravity="0 0 0" integrator="implicitfast"/>'
        text = f"<mujoco>{options}<worldbody>{body}{'</body>' * JOINTS}</worldbody></mujoco>"
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)

    def step(self, couple):
        """Advance by ``STEP`` under couples (JOINTS,) [N·m]."""
        self.data.qfrc_applied[:] = couple
        mujoco.mj_step(self.model, self.data)

    @property
    def joint(self):
        """(JOINTS,) [rad]."""
        return self.data.qpos.copy()


# %%
# What the project asks of it
# ---------------------------
# A method and three properties: that is the whole interface, ``der_planner.control.lockstep.Plant``.


class Arm:
    """The simulator with its air."""

    def __init__(self):
        self.chain = MujocoChain() if mujoco else NumpyChain()
        self.differential_pressure = np.zeros(2)  # in the chambers [Pa]

    def advance(self, command, duration):
        """Hold a command (2,) [Pa] for a time [s]."""
        for _ in range(max(1, round(duration / STEP))):
            self.differential_pressure += STEP / LAG * (command - self.differential_pressure)
            self.chain.step(COUPLE * np.repeat(self.differential_pressure, JOINTS // 2))

    @property
    def bend_angles(self):
        """(2,) [rad]."""
        return self.chain.joint.reshape(2, -1).sum(axis=1)

    @property
    def tip(self):
        """(2,) [m]."""
        heading = np.cumsum(self.chain.joint)
        return LINK * np.array([np.cos(heading).sum(), np.sin(heading).sum()])


print("simulated by", f"MuJoCo {mujoco.__version__}" if mujoco else "numpy: MuJoCo is not installed")

# %%
# Identify it
# -----------
# The planner's rod learns the chain from a run, as it would any limb. The prior's stiffness and gain may be
# off by a factor of two; weigh the limb, its mass is not identified.

prior = Limb.default().weighing(MASS)
excitation = calibration_run(0.6 * prior.pneumatics.pressure_limit, quick=True)
arm, rows = Arm(), []
for command in excitation.differential_pressure:
    rows.append((command, arm.differential_pressure.copy(), arm.bend_angles, arm.tip))
    arm.advance(command, 0.05)
commanded, measured, bend, tip = (np.array(column) for column in zip(*rows, strict=True))
draw = np.random.default_rng(0)
log = CalibrationLog(
    excitation.time, commanded, measured + 5 * draw.standard_normal(measured.shape),
    bend + 1e-3 * draw.standard_normal(bend.shape), tip + 1e-4 * draw.standard_normal(tip.shape), "chain",
)  # fmt: skip
limb, report = fit(prior, log)
print("open-loop error of the bend angles", np.rad2deg(report.residual).round(2), "degrees")

# %%
# Plan, learn, correct
# --------------------

made = plan(limb, Motion.named("star", cycles=1))
learner, errors, played = Learner(made), [], None
for _ in range(3):
    played = play(learner.next(), Arm())
    errors.append(played.error.mean())
    learner.add(played.time, played.tip)
feedback = Feedback(made)
corrected = play(made, Arm(), feedback, Sensors())
print("mean error in mm: planned, learned once, twice", np.round(1e3 * np.array(errors), 2))
print("with feedback", round(1e3 * corrected.error.mean(), 2))
if feedback.warnings:
    print("feedback was slowed or stopped:", feedback.warnings[0].message)
else:
    print(f"feedback stayed on: it sent {100 * feedback.share:.0f} % of its corrections at the end")
assert errors[0] < 0.01
assert min(errors[1:]) < errors[0]

for label, run in (("learned", played), ("feedback", corrected), ("open loop", play(made, Arm()))):
    plt.plot(*run.tip.T, label=label)
plt.plot(*made.tip_reference.T, "k--", lw=1, label="asked for")
middle, body = len(made.time) // 2, Model.of(limb).kinematics
plt.plot(*made.curve(middle).T, "0.7", lw=4, label="planned limb")
plt.plot(*body.curve(corrected.bend_angles[middle]).T, "0.2", label="limb with feedback")
plt.axis("equal")
plt.xlabel("x [m]")
plt.ylabel("y [m]")
plt.legend()
plt.show()

# %%
# To stand behind the whole graph, the same class publishes topics: see *Bring my simulator or controller*.
