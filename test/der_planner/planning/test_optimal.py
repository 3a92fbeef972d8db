"""The optimal method: exact derivatives, the quadratic programme, windows."""

from dataclasses import replace

import numpy as np
import pytest
from limbs import with_air
from scipy.optimize import linprog

from der_planner.limb import Limb
from der_planner.model import CONTROL_PERIOD, RodModel
from der_planner.model.air import Air
from der_planner.planning import Motion, Workspace, optimal, planner
from der_planner.planning.configuration import configure
from der_planner.planning.optimal import WINDOW, Optimiser, solve_limited

LIMB = Limb.default()


def solver_for(limb, motion, window=WINDOW):
    model = RodModel(limb)
    reference = motion.reference(Workspace(model))
    configuration = configure(model, reference)
    warm, _ = planner.balance(configuration, reference, "projected")
    return Optimiser(configuration, reference, warm, window=window)


@pytest.fixture(scope="module")
def fast():
    return solver_for(LIMB, Motion.named("asynchronous", period=4.0, cycles=1))


def test_gradient_of_the_cost_against_finite_differences(fast):
    rng = np.random.default_rng(1)
    first, last = 30, 60
    command = fast.warm + rng.normal(scale=30.0, size=fast.warm.shape)
    state = fast.model.rest
    _, misses, _ = fast._evaluate(command, state, first, last)
    jacobian, _ = fast._linearise(fast.drive.window(command[:last], first), state, 0.0)
    gradient = fast._gradient(jacobian, misses, command[:last], first)
    direction = rng.normal(size=(last - first, 2))
    ahead, behind = command.copy(), command.copy()
    ahead[first:last] += direction
    behind[first:last] -= direction
    slope = (
        fast._evaluate(ahead, state, first, last)[0] - fast._evaluate(behind, state, first, last)[0]
    )
    assert gradient @ direction.ravel() == pytest.approx(slope / 4, rel=1e-5)


def test_windows_agree_with_one_window():
    motion = Motion.named("opposite_direction", period=6.0, cycles=1)
    whole = solver_for(LIMB, motion, window=1000).run()
    windows = solver_for(LIMB, motion).run()
    assert len(windows.commands) > 1.2 * WINDOW
    assert np.abs(whole.tip - windows.tip).max() < 5e-5
    assert np.abs(whole.commands - windows.commands).max() < 60.0


@pytest.mark.parametrize(("name", "period"), [("asynchronous", 6.0), ("opposite_direction", 3.0)])
def test_the_optimum_is_found_in_few_steps_whatever_the_dead_time(name, period):
    """The linearisation must know the delay: without, the plan takes 12 steps and misses more."""
    limb = with_air(LIMB, slew_limit=1e6, pressure_limit=1e5, delay=0.12)
    solver = solver_for(limb, Motion.named(name, 0.6, period, 1))
    found = solver.run()
    assert found.steps <= 4
    assert np.linalg.norm(found.tip[1:] - solver.target[:-1], axis=1).mean() < 3e-5


def test_nothing_within_the_limits_is_better_than_the_limited_programme():
    rng = np.random.default_rng(2)
    size, inputs = 8, 2
    root = rng.normal(size=(size * inputs, size * inputs)) * 8e-6
    H = root.T @ root + 1e-11 * np.eye(size * inputs)
    gradient = rng.normal(size=size * inputs) * 2e-8
    command = np.cumsum(rng.uniform(-300, 300, size=(size, inputs)), axis=0)
    air = Air(replace(LIMB.pneumatics, pressure_limit=1500.0, slew_limit=450.0 / CONTROL_PERIOD))
    found = solve_limited(H, gradient, command, np.zeros(inputs), air)
    assert np.abs(found).max() <= 1500.0
    assert np.abs(np.diff(found, axis=0, prepend=0.0)).max() <= 450.0 + 1e-9
    # No command within the limits lies downhill from the optimum of a convex programme.
    slope = H @ (found - command).ravel() + gradient
    steps = np.eye(size * inputs) - np.eye(size * inputs, k=-inputs)
    most = np.full(4 * size, 450.0)
    slope /= np.abs(slope).max()
    lowest = linprog(slope, A_ub=np.vstack([steps, -steps]), b_ub=most, bounds=(-1500, 1500))
    assert lowest.success
    assert slope @ found.ravel() == pytest.approx(lowest.fun, rel=1e-3)


def test_each_window_begins_within_the_limits(monkeypatch):
    """Where a window has moved away from the guess of the next one, there is no jump between."""
    motion = Motion.named("asynchronous", amplitude=0.2, period=4.0, cycles=1)
    solver = solver_for(LIMB, motion, window=30)
    monkeypatch.setattr(optimal, "_SETTLED", 20)
    guess = np.zeros_like(solver.warm)

    def moved(command, state, first, last):
        if first == 0:
            command[:last] += np.linspace(0.0, 4000.0, last)[:, None]
        return 1, False

    monkeypatch.setattr(solver, "improve", moved)
    found = solver.run(begin=guess).commands
    assert found[19].min() > 2000.0
    assert found[-1].max() < 1.0
    steps = np.diff(found, axis=0, prepend=0.0)
    assert np.abs(steps).max() <= LIMB.pneumatics.slew_limit * CONTROL_PERIOD + 1e-6
