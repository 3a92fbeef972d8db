"""Motions: the paper's formulas, paths from files, refusals, the nearest path to any drawing."""

import math
from dataclasses import replace

import numpy as np
import pytest
from limbs import with_segments

from der_planner.limb import Limb
from der_planner.model import ArcModel, RodModel
from der_planner.planning import (
    NAMES,
    Motion,
    PathLimits,
    PlanningError,
    UnreachableError,
    Workspace,
    plan,
)
from der_planner.planning.configuration import configure
from der_planner.planning.paths import TipPath

LIMB = Limb.default()
SPACE = Workspace(RodModel(LIMB))


@pytest.mark.parametrize("name", NAMES)
def test_every_motion_starts_and_ends_at_rest_in_the_straight_pose(name):
    reference = Motion.named(name, amplitude=0.6, period=6.0, cycles=1).reference(SPACE)
    ends = np.array([0.0, reference.duration])
    angles, rates, accelerations = reference.sample(ends)
    np.testing.assert_allclose(angles, 0.0, atol=1e-8)
    np.testing.assert_allclose(rates, 0.0, atol=1e-8)
    np.testing.assert_allclose(accelerations, 0.0, atol=1e-6)
    np.testing.assert_allclose(reference.tip[0], [LIMB.length, 0.0], atol=1e-9)
    np.testing.assert_allclose(np.diff(reference.time), 0.05, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "second"),
    [
        ("same_direction", lambda t: 0.5 * 0.7 * (1 - np.cos(2 * np.pi * t / 8))),
        ("opposite_direction", lambda t: -0.5 * 0.7 * (1 - np.cos(2 * np.pi * t / 8))),
        ("asynchronous", lambda t: 0.5 * 0.7 * (1 - np.cos(2 * np.pi * (t - 2) / 8))),
    ],
)
def test_named_motions_follow_the_papers_formulas_after_the_fade(name, second):
    reference = Motion.named(name, amplitude=0.7, period=8.0, cycles=2).reference(SPACE)
    time = np.linspace(2.0, 16.0, 200)
    angles, _, _ = reference.sample(time)
    np.testing.assert_allclose(
        angles[:, 0], 0.5 * 0.7 * (1 - np.cos(2 * np.pi * time / 8)), atol=1e-7
    )
    np.testing.assert_allclose(angles[:, 1], second(time), atol=1e-7)


def test_a_path_without_times_keeps_the_limits():
    turn = np.linspace(0, 2 * np.pi, 60)
    centre = Motion.named("circle").reference(SPACE).tip.mean(axis=0)
    points = centre + 0.008 * np.column_stack([np.cos(turn), np.sin(turn)])
    limits = PathLimits(speed=0.02, acceleration=0.03)
    path = TipPath.build(None, points, limits)
    time, tip = path.resample(0.01)
    speed = np.linalg.norm(np.gradient(tip, time, axis=0), axis=1)
    twist = np.linalg.norm(np.gradient(np.gradient(tip, time, axis=0), time, axis=0), axis=1)
    assert speed.max() < 1.02 * limits.speed
    assert speed[0] < 0.1 * limits.speed
    assert np.median(twist) < 1.5 * limits.acceleration
    np.testing.assert_allclose(tip[[0, -1]], points[[0, -1]], atol=1e-6)


def test_a_tip_that_is_to_wait_waits():
    here, there = [0.22, 0.08], [0.20, 0.11]
    path = TipPath.build([0.0, 2.0, 6.0, 8.0], [here, there, there, here])
    time, tip = path.resample(0.02)
    waits = (time >= 2.0) & (time <= 6.0)
    np.testing.assert_allclose(tip[waits], np.tile(there, (waits.sum(), 1)), atol=1e-12)


def test_csv_paths(tmp_path):
    file = tmp_path / "spot.csv"
    file.write_text("time, x, y\n0, 0.20, 0.10\n1, 0.195, 0.11\n2, 0.19, 0.12\n")
    motion = Motion.from_csv(file)
    assert motion.name == "spot"
    reference = motion.reference(SPACE)
    assert np.linalg.norm(reference.tip - [0.195, 0.11], axis=1).min() < 1e-4
    file.write_text("x,y\n0.20,0.10\n0.19,0.12\n")
    assert Motion.from_csv(file).reference(SPACE).duration > 2.0
    for header in ("t_ms, x [cm], y [mm]", "time [ms], x (cm), y_mm, remark"):
        file.write_text(f"{header}\n0, 20, 100, start\n1000, 19.5, 110,\n\n2000, 19, 120, end\n")
        path = Motion.from_csv(file).path
        np.testing.assert_allclose(path.time, [0.0, 1.0, 2.0])
        np.testing.assert_allclose(path.tip, [[0.2, 0.1], [0.195, 0.11], [0.19, 0.12]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "no column 'x'"),
        ("x,y\n0.2,0.1\n0.2,high\n", "line 3: column 'y' is not a number: 'high'"),
        ("time,x,y\n0,0.2,0.1\n0,0.2,0.11\n", "times of a tip path must increase: point 1"),
        ("x,y\n0.2,0.1\n", "two or more points"),
        ("x,y\n0.2,0.1\nnan,0.1\n", "line 3: column 'x' is not a number: 'nan'; correct or remove"),
        ("x [inch],y\n0.2,0.1\n", r"line 1: column 'x \[inch\]' has the unit inch: use m, cm, mm"),
        ("x,y\n0.2,0.1\n0.2,0.1\n", "all points of the tip path coincide"),
        ("", "no column 'x'"),
        (None, r"cannot read tip path .*bad\.csv"),
    ],
)
def test_bad_csv_is_named(tmp_path, text, message):
    file = tmp_path / "bad.csv"
    if text is not None:
        file.write_text(text)
    with pytest.raises(PlanningError, match=message):
        Motion.from_csv(file)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": "jump"}, "motion 'jump' is unknown: choose asynchronous"),
        ({"amplitude": -1.0}, "amplitude must be positive"),
        ({"amplitude": 45.0}, "is it in radians"),
        ({"period": 0.0}, "period must be positive"),
        ({"period": 0.1}, "the shortest is"),
        ({"cycles": 0}, "cycles must be a whole number"),
        ({"cycles": 10**6}, "longer than"),
    ],
)
def test_bad_motions_are_named(arguments, message):
    with pytest.raises(PlanningError, match=message):
        Motion.named(**{"name": "asynchronous", **arguments})


def test_an_unreachable_path_names_time_point_and_distance():
    time = np.linspace(0, 4, 41)
    tip = np.column_stack([np.linspace(0.20, 0.26, 41), np.full(41, 0.10)])
    with pytest.raises(UnreachableError) as caught:
        Motion.from_tip_path(time, tip).reference(SPACE)
    error = caught.value
    assert 0.5 < error.time < 2.0
    assert error.point[1] == pytest.approx(0.10)
    assert 0.0 < error.distance < 0.01
    assert math.isnan(error.required_pressure)
    assert "out of reach" in str(error)
    assert "nearest=True; --nearest" in str(error)


@pytest.mark.parametrize("nearest", [False, True])
def test_a_path_in_millimetres_is_refused_by_its_unit(nearest):
    motion = Motion.from_tip_path(None, [(120.0, 80.0), (110.0, 90.0)], nearest=nearest)
    said = r"in metres: 120 is 492 lengths of the limb; millimetres are divided by 1000"
    with pytest.raises(PlanningError, match=said):
        motion.reference(SPACE)


def test_a_pose_beyond_the_pressure_limit_says_what_it_would_need():
    weak = Limb("weak", LIMB.segments, type(LIMB.pneumatics)(10e3, 9e3, 9e3, 0.15))
    tip = ArcModel(weak).tip(np.radians([[45.0, 45.0], [46.0, 46.0]]))
    with pytest.raises(UnreachableError, match=r"it would need 1\d\.\d kPa") as caught:
        Motion.from_tip_path([0.0, 1.0], tip).reference(Workspace(RodModel(weak)))
    assert caught.value.required_pressure == pytest.approx(12.4e3, rel=0.01)


ARCS = ArcModel(LIMB)

CENTRE = ARCS.tip([0.9, 0.9])
TURN = np.linspace(0.0, 2 * np.pi, 90)
RING = np.column_stack([np.cos(TURN), np.sin(TURN)])
NOISE = np.random.default_rng(5).normal(0.0, 3e-4, (10_000, 2))
MANY = np.linspace(0.0, 2 * np.pi, 10_000)
TREMBLING = CENTRE + 0.02 * np.column_stack([np.cos(MANY), np.sin(MANY)]) + NOISE
FOREIGN = {
    "a circle partly outside": (None, CENTRE + 0.03 * RING),
    "the same in its own time": (np.linspace(0, 20, 90), CENTRE + 0.03 * RING),
    "far too fast": (np.linspace(0, 1, 90), CENTRE + 0.03 * RING),
    "through the fold": (None, [(0.3, 0.0), (0.1, 0.0)]),
    "from one side to the other": (None, [(0.15, 0.15), (0.15, -0.15)]),
    "one place": (None, np.tile(CENTRE, (5, 1))),
    "one place out of reach, for a while": (np.arange(5.0), np.tile([0.3, 0.3], (5, 1))),
    "behind the clamp": (None, [(-0.1, 0.0), (-0.1, 0.05)]),
    "ten thousand points": (None, TREMBLING),
    "ten thousand points in time": (np.linspace(0, 20, 10_000), TREMBLING),
}


@pytest.mark.parametrize("drawn", FOREIGN)
def test_what_comes_out_can_be_followed(drawn):
    reference = Motion.from_tip_path(*FOREIGN[drawn], nearest=True).reference(SPACE)
    low, high = SPACE.low, SPACE.high
    assert np.all(reference.bend_angles >= low)
    assert np.all(reference.bend_angles <= high)
    steps = np.abs(np.diff(reference.bend_angles, axis=0)).max() / 0.05
    slew = LIMB.pneumatics.slew_limit * LIMB.static_gain.max()
    assert steps < 1.1 * slew
    assert np.abs(np.diff(reference.bend_angles, 2, axis=0)).max() / 0.05**2 < 3.0  # rad/s²


def test_a_path_within_reach_is_followed_in_its_own_time():
    named = Motion.named("circle", amplitude=0.7, period=8.0, cycles=1).reference(SPACE)
    inner = slice(60, 160)
    time, tip = named.time[inner], named.tip[inner]
    for nearest, tolerance in ((False, 2e-5), (True, 5e-4)):
        reference = Motion.from_tip_path(time, tip, nearest=nearest).reference(SPACE)
        lead = np.argmin(np.linalg.norm(reference.tip - tip[0], axis=1))
        followed = reference.tip[lead : lead + len(tip)]
        assert np.linalg.norm(followed - tip, axis=1).max() < tolerance
    assert reference.deviation.largest < 2e-4
    assert reference.deviation.slowed == 1.0
    assert str(reference.deviation) == ""


def test_where_and_how_far_the_path_is_left_is_said():
    time, tip = FOREIGN["one place out of reach, for a while"]
    deviation = Motion.from_tip_path(time, tip, nearest=True).reference(SPACE).deviation
    assert deviation.mean == pytest.approx(SPACE.distance_to_reach(tip[0], [1.0, 1.0]), rel=0.01)
    assert deviation.share == 1.0
    line = np.linspace(CENTRE - [0.004, 0.0], CENTRE + np.array([0.06, 0.0]), 40)
    motion = Motion.from_tip_path(np.linspace(0, 10, 40), line, nearest=True)
    deviation = motion.reference(SPACE).deviation
    assert deviation.point == pytest.approx(line[-1], abs=1e-3)
    assert 0.2 < deviation.share < 0.95


def test_a_trembling_hand_is_smoothed():
    radius = np.linalg.norm(TREMBLING - CENTRE, axis=1).std()
    small = CENTRE + 0.4 * (TREMBLING - NOISE - CENTRE) + NOISE
    reference = Motion.from_tip_path(None, small, nearest=True).reference(SPACE)
    on_circle = np.linalg.norm(reference.tip - CENTRE, axis=1)
    inner = slice(len(on_circle) // 3, 2 * len(on_circle) // 3)
    assert on_circle[inner].std() < 0.3 * radius
    assert reference.deviation.largest < 1e-3
    assert reference.duration < 40.0  # the hand's steps add up to half a minute of path


@pytest.mark.parametrize("segments", [1, 3])
def test_other_numbers_of_segments(segments):
    limb = replace(LIMB, segments=(LIMB.segments[0],) * segments)
    centre = ArcModel(limb).tip(np.full(segments, 0.6))
    reference = Motion.from_tip_path(None, centre + 0.02 * RING, nearest=True).reference(
        Workspace(RodModel(limb))
    )
    assert reference.bend_angles.shape == (len(reference.time), segments)
    assert reference.deviation.mean < 0.015


@pytest.mark.parametrize("model", ["der", "pcc"])
def test_the_plan_says_how_far_it_is_from_the_drawing(model):
    motion = Motion.from_tip_path(None, CENTRE + 0.03 * RING, nearest=True)
    planned = plan(LIMB, motion, model, "paper" if model == "pcc" else "projected")
    assert "nearest path leaves" in planned.warnings[0]
    assert np.abs(planned.differential_pressure).max() <= LIMB.pneumatics.pressure_limit
    assert planned.predicted_error < 2e-3


def uneven_limb(random):
    """Return the limb as a calibration may find it: segments of other gains, bent at rest."""
    return with_segments(
        LIMB,
        moment_gain=lambda s: s.moment_gain * random.uniform(0.8, 1.4),
        rest_curvature=lambda _: random.normal(0.0, 0.4),
    )


def scrawl(random):
    """Return a small line (P, 2) [m] as a hand scrawls it, mostly where no tip comes."""
    waves = random.normal(0.0, 0.006, (3, 2)) / np.arange(1, 4)[:, None]
    phases = random.uniform(0.0, 2 * np.pi, (3, 2))
    turns = np.arange(1, 4)[:, None, None] * np.linspace(0.0, 2 * np.pi, 40)[:, None]
    middle = random.uniform([-0.05, -0.28], [0.3, 0.28])
    return middle + (waves[:, None] * np.sin(turns + phases[:, None])).sum(axis=0)


@pytest.mark.slow
def test_no_scrawl_is_refused():
    """The nearest path that is shown is one that the rod can be planned along.

    28, 51 and 66 were refused where bend angles went beyond their limits at the edge of the reach.
    """
    left = []
    for seed in (*range(6), 28, 51, 66):
        random = np.random.default_rng(seed)
        body = RodModel(uneven_limb(random))
        space = Workspace(body)
        reference = Motion.from_tip_path(None, scrawl(random), nearest=True).reference(space)
        angles = configure(body, reference).bend_at(reference.time)
        assert np.all((angles > space.low - 1e-6) & (angles < space.high + 1e-6))
        left.append(np.linalg.norm(body.kinematics.tip(angles) - reference.tip, axis=1).max())
    assert max(left) < 5e-3, "the rod stays where it is shown"
    assert np.mean(np.array(left) > 1e-4) > 0.1, "many of them are at the edge"
