"""Motions: the paper's formulas, rest at both ends, paths from files, refusals."""

import math

import numpy as np
import pytest

from der_planner.limb import Limb
from der_planner.model import ArcModel, RodModel
from der_planner.planning import (
    NAMES,
    Motion,
    PathLimits,
    PlanningError,
    UnreachableError,
    Workspace,
)
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
