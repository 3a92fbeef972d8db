"""Inverse kinematics, its branches and reach; things in the way of a motion."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest

from der_planner.limb import Limb
from der_planner.model import ArcModel, RodModel
from der_planner.model.bending import PolylineKinematics, bend_angles, inverse_kinematics
from der_planner.planning import (
    Motion,
    ObstacleError,
    Obstacles,
    PlanningError,
    Workspace,
    plan,
    workspace,
)
from der_planner.planning.configuration import configure
from der_planner.rod import Rod

LIMB = Limb.default()
ARCS = ArcModel(LIMB)
SPACE = Workspace(ARCS)
CHAIN = RodModel(LIMB).kinematics


@pytest.mark.parametrize("angles", [[0.9, -0.9], [0.2, 0.7], [0.0, 0.0], [3.0, 2.9], [-3.1, 0.4]])
def test_an_evenly_bent_chain_has_these_bend_angles_and_tangents(angles):
    rod = Rod.from_limb(LIMB, 21)
    np.testing.assert_allclose(bend_angles(rod, CHAIN.configuration(angles)), angles, atol=1e-13)
    step = 1e-6 * np.eye(2)
    slope = (CHAIN.nodes(angles + step) - CHAIN.nodes(angles - step)) / 2e-6
    np.testing.assert_allclose(CHAIN.tangents(angles), slope, atol=1e-9)
    np.testing.assert_allclose(CHAIN.tip_jacobians(angles), slope[:, -1].T, atol=1e-9)
    still = CHAIN.configuration(np.zeros(2))
    np.testing.assert_allclose(still, rod.straight_state().q, atol=1e-15)


def test_a_stiff_base_moves_the_limb_along_x():
    based = replace(LIMB, base_length=7e-3)
    model, rod = RodModel(based), Rod.from_limb(based, 21)
    angles = [0.9, -0.4]
    q = PolylineKinematics(rod).configuration(angles)
    np.testing.assert_allclose(model.kinematics.nodes(angles), rod.positions(q)[:, :2], atol=1e-14)
    for with_base, without in ((model.kinematics, CHAIN), (ArcModel(based), ARCS)):
        np.testing.assert_allclose(
            with_base.tip(angles), without.tip(angles) + np.array([7e-3, 0.0])
        )
        curve = with_base.curve(angles)
        np.testing.assert_allclose(curve[[0, 1]], [[0.0, 0.0], [7e-3, 0.0]], atol=1e-15)
        np.testing.assert_allclose(curve[-1], with_base.tip(angles), atol=1e-14)
    pressure = np.array([8000.0, -5000.0])
    tips = [
        robot.positions(robot.equilibrium(pressure))[-1] for robot in (rod, Rod.from_limb(LIMB, 21))
    ]
    np.testing.assert_allclose(tips[0] - tips[1], [7e-3, 0.0, 0.0], atol=1e-9)
    assert based.length == pytest.approx(LIMB.length + 7e-3)


def test_velocity_and_acceleration_of_the_chain_are_derivatives():
    rng = np.random.default_rng(2)
    q, v, a = rng.normal(size=(3, 2))
    h = 1e-4

    def at(t):
        return CHAIN.nodes(q + v * t + 0.5 * a * t * t)

    _, velocity, acceleration = CHAIN.motion(q, v, a)
    np.testing.assert_allclose(velocity, (at(h) - at(-h)) / (2 * h), atol=1e-8)
    np.testing.assert_allclose(acceleration, (at(h) - 2 * at(0) + at(-h)) / h**2, atol=1e-6)


@pytest.mark.parametrize("kinematics", [ARCS, CHAIN], ids=["arcs", "rod"])
def test_inverse_of_forward_is_the_identity(kinematics):
    rng = np.random.default_rng(3)
    angles = rng.uniform(-1.2, 1.2, size=(200, 2))
    away = np.abs(np.linalg.det(kinematics.tip_jacobians(angles))) > 2e-3
    angles = angles[away]
    guess = angles + rng.normal(scale=0.02, size=angles.shape)
    found, miss = inverse_kinematics(kinematics, kinematics.tip(angles), guess, prior_weight=0.0)
    assert miss.max() < 1e-12
    np.testing.assert_allclose(found, angles, atol=1e-8)


def test_both_branches_are_found_and_named():
    point = ARCS.tip(np.radians([35.0, 20.0]))
    found = SPACE.solutions(point)
    assert {item.branch for item in found} == set(workspace.BRANCHES)
    assert len(found) == 2
    for item in found:
        np.testing.assert_allclose(ARCS.tip(item.bend_angles), point, atol=1e-9)
        assert workspace.branch_of(ARCS, item.bend_angles) == item.branch
    assert found[0].pressure <= found[1].pressure
    turns = {item.branch: item.bend_angles[1] for item in found}
    assert turns["counter_clockwise"] > turns["clockwise"]


@pytest.mark.parametrize("branch", workspace.BRANCHES)
def test_a_path_stays_on_the_branch_it_was_given(branch):
    turn = np.linspace(0, 2 * np.pi, 50)
    centre = ARCS.tip(np.radians([35.0, 20.0]))
    tip = centre + 0.003 * np.column_stack([np.cos(turn), np.sin(turn)])
    angles = SPACE.follow(turn, tip, branch)
    assert {workspace.branch_of(ARCS, q) for q in angles} == {branch}
    np.testing.assert_allclose(ARCS.tip(angles), tip, atol=1e-8)
    assert np.abs(np.diff(angles, axis=0)).max() < 0.1
    with pytest.raises(PlanningError, match="branch 'left' is unknown"):
        SPACE.follow(turn, tip, "left")


def test_a_path_through_the_straight_pose_is_smooth():
    s = np.linspace(0, np.pi, 81)
    theta = 0.4 * np.sin(s) ** 3
    for second in (1.0, -1.0):
        wanted = np.column_stack([theta, second * theta])
        found, miss = inverse_kinematics(CHAIN, ARCS.tip(wanted), wanted)
        assert miss.max() < 1e-6
        assert np.all(np.isfinite(found))
        assert (
            np.abs(np.diff(found, 2, axis=0)).max() < 3 * np.abs(np.diff(wanted, 2, axis=0)).max()
        )


@pytest.mark.parametrize("segments", [3, 4])
def test_a_limb_of_many_segments_rests_where_its_path_rests(segments):
    """What the tip leaves open must not drift, or the limb would never come home from there."""
    space = Workspace(ArcModel(replace(LIMB, segments=LIMB.segments[:1] * segments)))
    for shape in ("circle", "figure_eight"):
        reference = Motion.named(shape, amplitude=0.5, cycles=1).reference(space)
        assert np.all(reference.bend_angles < space.high)
        assert np.abs(np.diff(reference.bend_angles, axis=0)).max() < 0.05 * space.fastest.max()


def test_distance_to_reach_agrees_with_a_search():
    low, high = SPACE.low, SPACE.high
    grid = np.stack(
        np.meshgrid(*(np.linspace(a, b, 301) for a, b in zip(low, high, strict=True))), -1
    )
    tips = ARCS.tip(grid).reshape(-1, 2)
    for point in ([0.26, 0.10], [0.10, 0.02], [0.0, 0.0]):
        searched = np.linalg.norm(tips - point, axis=1).min()
        found = SPACE.distance_to_reach(point, np.array([0.1, 0.1]))
        assert found <= searched + 1e-9
        assert found == pytest.approx(searched, abs=1e-3)


MOTION = Motion.named("same_direction", amplitude=0.4, period=4.0, cycles=1)
RADIUS = 0.015


def circle(point, radius=0.01, allowed=0.0):
    item = {"circle_m": list(point), "radius_m": radius, "allowed_force_n": allowed}
    return Obstacles.from_mapping({"limb_radius_m": RADIUS, "obstacles": [item]})


@pytest.fixture(scope="module")
def free():
    return plan(LIMB, MOTION, method="projected")


def beside(curve, share, depth):
    """Return where the middle of a peg is into which a limb of this curve runs by a depth [m]."""
    node = round(share * (len(curve) - 1))
    along = curve[node + 1] - curve[node - 1]
    left = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    return curve[node] + left * (RADIUS + 0.01 - depth)


def most_bent(motion):
    """Return the row in which the limb bends most."""
    return int(np.argmax(motion.bend_angles.sum(axis=1)))


@pytest.mark.parametrize("share", [0.5, 0.8])
def test_a_motion_into_a_peg_is_refused_with_instant_place_and_clearance(free, share):
    k = most_bent(free)
    point = beside(free.curve(k), share, 0.006)
    with pytest.raises(ObstacleError, match="mm into the circle") as refused:
        plan(LIMB, MOTION, method="projected", obstacles=circle(point))
    error = refused.value
    assert error.time == pytest.approx(free.time[k], abs=0.3)
    assert error.place == pytest.approx(share * LIMB.length, abs=0.05 * LIMB.length)
    assert error.clearance == pytest.approx(-0.006, abs=1e-3)
    # So it is with a force that is a little too small, and not with one that is enough.
    with pytest.raises(ObstacleError):
        plan(LIMB, MOTION, method="projected", obstacles=circle(point, allowed=0.9 * error.force))
    enough = circle(point, allowed=1.1 * error.force)
    said = " ".join(plan(LIMB, MOTION, method="projected", obstacles=enough).warnings)
    assert f"with up to {error.force:.2f} N; the tip is predicted as if nothing held it" in said


@pytest.mark.parametrize("method", ["projected", "optimal"])
def test_no_allowed_force_leads_a_limb_through_a_peg(free, method):
    k = most_bent(free)
    half_way = (free.curve(0) + free.curve(k))[len(free.curve(k)) * 4 // 5] / 2
    with pytest.raises(ObstacleError, match="which no force brings about"):
        plan(LIMB, MOTION, method=method, obstacles=circle(half_way, allowed=5.0))
    with pytest.raises(PlanningError, match="be touched with 200 N, and"):
        plan(LIMB, MOTION, method=method, obstacles=circle(half_way, allowed=200.0))


def edge(y, normal):
    item = {"half_plane_m": [0.0, y], "normal": [0.0, normal]}
    return Obstacles.from_mapping({"limb_radius_m": RADIUS, "obstacles": [item]})


@pytest.mark.parametrize(
    ("mounting", "amplitude", "share", "most"),
    [
        ("horizontal", 0.4, 0.8, 0.012),
        ("sideways", 0.2, 0.8, 0.012),
        ("horizontal", 0.8, 0.0, 0.15),
    ],
    ids=["peg", "peg in a sagging limb's way", "edge beside the middle"],
)
def test_the_optimal_plan_leads_the_limb_past_what_it_cannot_touch(
    mounting, amplitude, share, most
):
    limb = dataclasses.replace(LIMB, base_length=0.004).mounted(mounting)
    motion, model = dataclasses.replace(MOTION, amplitude=amplitude, period=10.0), RodModel(limb)

    def curves(reference):
        return configure(model, reference).curves(reference.time)

    reference = motion.reference(Workspace(model))
    poses = curves(reference)
    bent = poses[most_bent(reference)]
    middle = bent[len(bent) // 2, 1] + RADIUS - 0.006
    way = circle(beside(bent, share, 0.006)) if share else edge(middle, -1.0)
    found = plan(limb, motion, obstacles=way)
    assert way.nearest(way.items[0], poses).clearance < -0.0055
    assert way.nearest(way.items[0], curves(found.reference)).clearance > 1e-3
    # It leaves the path only beside what is in the way, and as little as it must.
    left_by = np.linalg.norm(found.tip_reference - reference.tip, axis=1)
    assert 0.0 < left_by.max() < most
    clearance = np.array([way.nearest(way.items[0], pose[None]).clearance for pose in poses])
    assert left_by[clearance > 0.02].max() < 3e-3
    assert "leads the tip" in " ".join(found.warnings)
    assert np.linalg.norm(found.tip_predicted - found.tip_reference, axis=1).mean() < 5e-4


def test_what_is_beside_the_motion_changes_nothing(free):
    point = beside(free.curve(most_bent(free)), 0.8, -0.002)
    for way in (circle(point), edge(-RADIUS - 0.001, 2.0)):
        kept = plan(LIMB, MOTION, method="projected", obstacles=way)
        np.testing.assert_array_equal(kept.differential_pressure, free.differential_pressure)
    with pytest.raises(ObstacleError, match="the edge at"):
        plan(LIMB, MOTION, method="projected", obstacles=edge(0.05, -1.0))


def test_a_file_says_what_is_wrong_with_it(tmp_path):
    file = tmp_path / "obstacles.yaml"
    for text, said in (
        ("limb_radius_m: 0.01\nobstacles: [{radius_m: 0.01}]\n", "an obstacle has"),
        ("limb_radius_m: -1\nobstacles: []\n", "0 or more"),
        ("limb_radius_m: 8 mm\nobstacles: []\n", "limb_radius_m must be a number, got 8 mm"),
        ("obstacles: []\n", "limb_radius_m"),
        ("limb_radius_m: 0.01\nobstacles: [{half_plane_m: [0, 0], normal: [0, 0]}]", "direction"),
    ):
        file.write_text(text)
        with pytest.raises(PlanningError, match=said):
            Obstacles.from_yaml(file)


@pytest.mark.parametrize(
    ("way", "said"),
    [
        (circle((120.0, 100.0), 10.0), "in metres"),
        (circle((0.12, 0.1), 10.0), "in metres"),
        (circle((0.12, 0.0)), "cm from its clamp"),
        (edge(-0.08, -1.0), "a normal that points"),
        (dataclasses.replace(edge(-0.08, 1.0), limb_radius=15.0), "limb_radius_m"),
    ],
)
def test_numbers_that_no_rig_has_are_refused(way, said):
    with pytest.raises(PlanningError, match=said):
        plan(LIMB, MOTION, obstacles=way)
