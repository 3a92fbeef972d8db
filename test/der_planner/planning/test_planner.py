"""Plans: the methods' identities, limits, hand-over between motions; the optimal method's parts."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
from limbs import with_air, with_segments
from scipy.optimize import linprog

from der_planner.limb import CalibratedRange, Limb
from der_planner.model import CONTROL_PERIOD, RodModel
from der_planner.model.air import Air
from der_planner.planning import (
    METHODS,
    Motion,
    PlanningError,
    Start,
    Workspace,
    optimal,
    plan,
    planner,
)
from der_planner.planning.configuration import RodConfiguration, configure
from der_planner.planning.optimal import WINDOW, Optimiser, solve_limited
from der_planner.planning.timing import resting_spline

LIMB = Limb.default()
CASES = ("asynchronous", "same_direction", "opposite_direction")
EVERY = [(model, method) for model, methods in METHODS.items() for method in methods]


UNEVEN = with_segments(
    with_air(LIMB, delay=0.03, vent_time_constant=0.2),
    length=[0.115, 0.129],
    bending_stiffness=[0.0175, 0.019],
    rest_curvature=[0.2, -0.1],
    cubic_stiffness=[4e-6, 0.0],
    material_damping=[0.02, 0.01],
    moment_gain=[9.1e-6, 8.2e-6],
    gain_asymmetry=[0.05, -0.04],
    pressure_stiffening=[2e-6, 1e-6],
    friction_moment=[4e-3, 0.0],
    friction_curvature=[0.3, 0.0],
    creep_stiffness=[1e-3, 0.0],
    creep_time=[8.0, 0.0],
)
FREE = with_air(LIMB, slew_limit=1e6, pressure_limit=1e5)


@pytest.fixture(scope="module")
def model():
    return RodModel(UNEVEN)


def full_force(model, k, q, v, a):
    """M q̈ + D q̇ − F_int − F_ext of the rod itself, in its full layout."""
    rod = model.rod
    position, velocity, acceleration = (part[k] for part in model.kinematics.motion(q, v, a))
    x, xd, xdd = rod.straight_state().q, np.zeros(4 * rod.nodes - 1), np.zeros(4 * rod.nodes - 1)
    for axis in range(2):
        x[axis::4], xd[axis::4], xdd[axis::4] = (
            part[:, axis] for part in (position, velocity, acceleration)
        )
    state = rod.state(x, xd)
    supplied = rod.internal_force(state) + rod.external_force - rod.damping_diagonal * xd
    return state, (rod.mass_diagonal * xdd - supplied)[rod.free]


def test_projected_pressures_leave_no_virtual_work(model):
    rng = np.random.default_rng(2)
    q, v, a = rng.normal(size=(3, 4, 2))
    pressures = model.balance.projected(q, v, a)
    for k in range(4):
        state, needed = full_force(model, k, q, v, a)
        supplied = model.rod.input_matrix(state)[model.rod.free] @ pressures[k]
        step = 1e-6 * np.eye(2)
        ahead, behind = (model.kinematics.configuration(q[k] + sign * step) for sign in (1, -1))
        tangents = (ahead - behind)[:, model.rod.free] / 2e-6
        work = tangents @ (needed - supplied)
        assert np.abs(work).max() < 1e-8 * np.abs(tangents @ needed).max() + 1e-12


def test_the_papers_gains_add_nothing_without_an_error_and_little_with_one():
    model = RodModel(LIMB)
    q = np.tile([0.3, 0.2], (40, 1))
    zero = np.zeros_like(q)
    state, needed = full_force(model, 0, q, zero, zero)
    balance = np.linalg.lstsq(model.rod.input_matrix(state)[model.rod.free], needed)[0]
    # The rolled rod starts straight, far from the reference: (B Λ)† sees only the few rows beside
    # the couples, so that a distributed error hardly comes back.
    time = 0.025 * np.arange(40)
    still = resting_spline(time, q)
    away = RodConfiguration(model, still, None).pressures("paper", time)
    assert 1e-5 < np.abs(away[0] / balance - 1).max() < 1e-2
    model.rest = model.rod.equilibrium(balance)
    settled = RodConfiguration(model, still, None).pressures("paper", time)
    np.testing.assert_allclose(settled, np.tile(balance, (40, 1)), rtol=1e-6)


@pytest.mark.parametrize("name", CASES)
def test_projected_beats_paper_and_optimal_beats_both(name):
    errors = {
        method: plan(FREE, Motion.named(name, period=6.0, cycles=1), "der", method).predicted_error
        for method in METHODS["der"]
    }
    assert errors["projected"] < 0.4 * errors["paper"]
    assert errors["optimal"] < 0.1 * errors["projected"]
    assert errors["optimal"] < 1e-5


@pytest.mark.parametrize(("model_name", "method"), EVERY)
def test_a_calibrated_limb_with_every_effect_is_followed(model_name, method):
    """What the planner assumes of chambers, friction and creep it also inverts."""
    result = plan(UNEVEN, Motion.named("asynchronous", period=8.0, cycles=1), model_name, method)
    bound = {"paper": 2.5e-3, "projected": 1.5e-3, "optimal": 2e-4}[method]
    assert result.predicted_error < bound


@pytest.mark.parametrize(("model_name", "method"), EVERY)
@pytest.mark.parametrize("name", ["same_direction", "star"])
def test_limits_are_never_violated(model_name, method, name):
    limb = with_air(LIMB, slew_limit=7000.0, pressure_limit=21e3)
    result = plan(limb, Motion.named(name, period=3.0, cycles=1), model_name, method)
    steps = np.diff(result.differential_pressure, axis=0, prepend=0.0)
    assert np.abs(result.differential_pressure).max() <= 21e3 + 1e-6
    assert np.abs(steps).max() <= 7000.0 * 0.05 + 1e-6
    assert result.slew_margin > -1e-3
    if method != "optimal":
        assert any("limits cut" in warning for warning in result.warnings)


def test_optimal_uses_what_the_limits_leave_better_than_cutting():
    motion = Motion.named("opposite_direction", period=3.0, cycles=1)
    cut = plan(LIMB, motion, "der", "projected")
    best = plan(LIMB, motion, "der", "optimal")
    assert best.predicted_error < 0.25 * cut.predicted_error
    assert best.slew_margin < 1e-3
    slow = Motion.named("same_direction", period=3.0, cycles=1)
    warnings = plan(LIMB, slow, "der", "optimal").warnings
    assert any("the limits leave a mean error of" in warning for warning in warnings)


@pytest.mark.parametrize(
    ("mounting", "model_name", "method"),
    [*(("horizontal", *each) for each in EVERY), ("hanging", "der", "optimal")],
)
def test_a_plan_takes_over_from_a_moving_limb(mounting, model_name, method):
    limb, k = LIMB.mounted(mounting), 70
    first = Motion.named("asynchronous", amplitude=0.5, period=8.0, cycles=1)
    before = plan(limb, first, model_name, method)
    start = Start(*before.reference.sample(before.time[k]), before.differential_pressure[k - 1])
    motion = Motion.named("same_direction", amplitude=0.4, period=6.0, cycles=1)
    after = plan(limb, motion, model_name, method, start=start)
    joined = np.vstack([before.differential_pressure[:k], after.differential_pressure])
    assert np.abs(np.diff(joined, axis=0)).max() <= limb.pneumatics.slew_limit * 0.05 + 1e-6
    np.testing.assert_allclose(after.tip_reference[0], before.tip_reference[k], atol=1e-9)
    assert after.largest_error < 4e-3


@pytest.mark.slow
def test_three_segments_with_gravity():
    segment = LIMB.segments[0]
    limb = dataclasses.replace(LIMB, segments=(segment,) * 3, gravity=(0.3, -0.2, 0.0))
    motion = Motion.named("same_direction", amplitude=0.4, period=10.0, cycles=1)
    paper = plan(limb, motion, "der", "projected", nodes=31)
    best = plan(limb, motion, "der", "optimal", nodes=31)
    assert best.differential_pressure.shape == (len(best.time), 3)
    assert best.predicted_error < 0.2 * paper.predicted_error
    assert plan(limb, motion, "pcc").predicted_error < 2e-3


def test_one_segment_follows_one_reference_by_every_model():
    limb = dataclasses.replace(LIMB, segments=LIMB.segments[:1])
    motion = Motion.named("asynchronous", period=6.0, cycles=1)
    reference = motion.reference(Workspace(RodModel(limb, 12)))
    for which in EVERY:
        result = plan(limb, motion, *which, nodes=12)
        np.testing.assert_array_equal(result.tip_reference, reference.tip)
        assert result.differential_pressure.shape == (len(result.time), 1)
        assert result.predicted_error < 3e-3


def test_warnings_name_what_the_calibration_did_not_cover():
    limb = dataclasses.replace(LIMB, calibrated=CalibratedRange((8e3, 8e3), (0.4, 0.9)))
    result = plan(limb, Motion.named("same_direction", period=20.0, cycles=1), "der", "projected")
    assert any("segment 0 bends by 4" in w and "covered 23" in w for w in result.warnings)


@pytest.mark.parametrize("model", ["der", "pcc"])
def test_warnings_name_another_mounting_than_the_calibrations(model):
    limb = dataclasses.replace(LIMB, calibrated=CalibratedRange((2e4, 2e4), (1.5, 1.5)))
    motion = Motion.named("asynchronous", 0.2, 8.0, 1)
    assert plan(limb, motion, model, "projected").warnings == ()
    (said,) = plan(limb.mounted("hanging"), motion, model, "projected").warnings
    assert said.startswith("the mounting is hanging, the limb was calibrated as horizontal: the")


def test_pcc_uses_its_own_identified_segments():
    softer = tuple(dataclasses.replace(s, moment_gain=2 * s.moment_gain) for s in LIMB.segments)
    limb = dataclasses.replace(LIMB, pcc_segments=softer)
    motion = Motion.named("same_direction", period=20.0, cycles=1)
    plain, own = plan(LIMB, motion, "pcc"), plan(limb, motion, "pcc")
    np.testing.assert_allclose(
        own.differential_pressure, plain.differential_pressure / 2, rtol=1e-6, atol=1e-6
    )


@pytest.mark.parametrize(
    ("model_name", "method", "message"),
    [
        ("fem", "", "model 'fem' is unknown: choose der or pcc"),
        ("pcc", "magic", "the model 'pcc' has no method 'magic': choose paper, projected, optimal"),
    ],
)
def test_unknown_models_and_methods_are_named(model_name, method, message):
    with pytest.raises(PlanningError, match=message):
        plan(LIMB, Motion.named("asynchronous"), model_name, method)


def test_what_is_no_motion_or_no_obstacles_is_told_how_to_make_them():
    with pytest.raises(PlanningError, match=r"got str: Motion\.named\(name\) with .*, star; or"):
        plan(LIMB, "star")
    with pytest.raises(PlanningError, match=r"got list: Obstacles\.from_yaml\(path\)"):
        plan(LIMB, Motion.named("asynchronous"), obstacles=[])


def test_cancelling_by_progress_ends_the_planning():
    class StopError(Exception):
        pass

    def progress(share):
        if share > 0.3:
            raise StopError

    with pytest.raises(StopError):
        plan(LIMB, Motion.named("asynchronous"), "der", "optimal", progress=progress)


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
