"""Things in the way: the clearance of a motion, the force of a touch, and what is refused."""

import dataclasses

import numpy as np
import pytest

from der_planner.limb import Limb
from der_planner.model import RodModel
from der_planner.planning import Motion, ObstacleError, Obstacles, PlanningError, plan
from der_planner.planning.configuration import configure
from der_planner.planning.workspace import Workspace

LIMB = Limb.default()
MOTION = Motion.named("same_direction", amplitude=0.4, period=4.0, cycles=1)
RADIUS = 0.015


def circle(point, radius=0.01, allowed=0.0):
    item = {"circle_m": list(point), "radius_m": radius, "allowed_force_n": allowed}
    return Obstacles.from_mapping({"limb_radius_m": RADIUS, "obstacles": [item]})


@pytest.fixture(scope="module")
def free():
    return plan(LIMB, MOTION, method="projected")


def beside(free, share, depth):
    """Return an obstacle that the limb runs into by a depth [m] where it bends most."""
    k = int(np.argmax(free.bend_angles.sum(axis=1)))
    curve = free.curve(k)
    node = round(share * (len(curve) - 1))
    along = curve[node + 1] - curve[node - 1]
    left = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    return curve[node] + left * (RADIUS + 0.01 - depth), free.time[k]


@pytest.mark.parametrize("share", [0.5, 0.8])
def test_a_motion_into_a_peg_is_refused_with_instant_place_and_clearance(free, share):
    point, when = beside(free, share, 0.006)
    with pytest.raises(ObstacleError, match="mm into the circle") as refused:
        plan(LIMB, MOTION, method="projected", obstacles=circle(point))
    error = refused.value
    assert error.time == pytest.approx(when, abs=0.3)
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
    k = int(np.argmax(free.bend_angles.sum(axis=1)))
    half_way = (free.curve(0) + free.curve(k))[len(free.curve(k)) * 4 // 5] / 2
    with pytest.raises(ObstacleError, match="which no force brings about"):
        plan(LIMB, MOTION, method=method, obstacles=circle(half_way, allowed=100.0))


@pytest.mark.parametrize("mounting", ["horizontal", "sideways"])
def test_the_optimal_plan_leads_the_limb_past_what_it_cannot_touch(mounting):
    limb = LIMB.mounted(mounting)
    model = RodModel(limb)

    def curves(reference):
        return configure(model, reference).curves(reference.time)

    reference = MOTION.reference(Workspace(model))
    poses = curves(reference)
    k = int(np.argmax(reference.bend_angles.sum(axis=1)))
    node = round(0.8 * (len(poses[k]) - 1))
    along = poses[k, node + 1] - poses[k, node - 1]
    left = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    way = circle(poses[k, node] + left * (RADIUS + 0.01 - 0.006))
    found = plan(limb, MOTION, obstacles=way)
    past = curves(dataclasses.replace(reference, tip=found.tip_reference))
    assert way.nearest(way.items[0], poses).clearance == pytest.approx(-0.006, abs=1e-3)
    assert way.nearest(way.items[0], past).clearance > 0.0
    # It leaves the path only beside the peg, by about what it would have run into it.
    left_by = np.linalg.norm(found.tip_reference - reference.tip, axis=1)
    assert 0.0 < left_by.max() < 0.012
    assert np.median(left_by) < 1e-3
    assert "leads the tip" in " ".join(found.warnings)
    assert np.linalg.norm(found.tip_predicted - found.tip_reference, axis=1).mean() < 5e-4


def edge(y, normal):
    item = {"half_plane_m": [0.0, y], "normal": [0.0, normal]}
    return Obstacles.from_mapping({"limb_radius_m": RADIUS, "obstacles": [item]})


def test_what_is_beside_the_motion_changes_nothing(free):
    point, _ = beside(free, 0.8, -0.002)
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
