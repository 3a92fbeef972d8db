"""Plans as files: what is read back and refused, and motions that begin from what is learned."""

import os
from dataclasses import replace

import numpy as np
import pytest
import yaml
from limbs import mean_error, other_limb, play, with_segments

from der_planner.control import Learner
from der_planner.limb import Limb
from der_planner.model import RodModel
from der_planner.planning import Motion, PlanningError, Start, plan
from der_planner.planning.configuration import configure
from der_planner.planning.correction import Correction, carried_over, nearest
from der_planner.planning.plan_file import learned_plan, read_plan, write_plan


@pytest.fixture(scope="module")
def bent():
    """Return a plan of a limb that rests bent, which begins where another motion is left.

    One of its numbers was computed by numpy.
    """
    motion = Motion.named("asynchronous", amplitude=0.3, period=3.0, cycles=1)
    start = Start(np.array([0.1, 0.05]), np.zeros(2), np.zeros(2), np.array([500.0, 100.0]))
    limb = with_segments(Limb.default(), rest_curvature=np.float64(0.3))
    return plan(limb, motion, method="projected", start=start)


def test_a_plan_is_read_back_whole(bent, tmp_path):
    beyond = np.arange(2.0 * len(bent.time)).reshape(-1, 2)
    bent = replace(bent, chambers_beyond=beyond)
    write_plan(bent, tmp_path / "kept" / "a.yaml", about={"runs": 3})
    again = read_plan(tmp_path / "kept" / "a.yaml")
    arrays = ("time", "differential_pressure", "tip_reference", "tip_predicted", "chambers_beyond")
    for name in arrays:
        assert np.array_equal(getattr(again, name), getattr(bent, name))
    assert again.limb.to_mapping() == bent.limb.to_mapping()
    assert np.allclose(again.bend_angles, bent.bend_angles, atol=1e-9)
    assert np.array_equal(again.reference.start.bend_angles, bent.reference.start.bend_angles)
    assert np.array_equal(again.reference.rest, bent.reference.rest)
    for name in ("motion", "model", "method", "amplitude", "period", "cycles"):
        assert getattr(again, name) == getattr(bent, name)
    assert [path.name for path in (tmp_path / "kept").iterdir()] == ["a.yaml"]


def test_a_plan_of_another_limb_load_or_name_is_not_played(bent, tmp_path):
    write_plan(bent, tmp_path / "a.yaml")
    assert learned_plan(tmp_path, "a", replace(bent.limb, name="renamed")).motion == "asynchronous"
    with pytest.raises(PlanningError, match=r"another masses\[0\]"):
        learned_plan(tmp_path, "a", bent.limb.carrying(0.02))
    stronger = replace(bent.limb.segments[1], moment_gain=1e-5)
    swapped = replace(bent.limb, segments=(bent.limb.segments[0], stronger))
    with pytest.raises(PlanningError, match=r"another segments\[1\].moment_gain"):
        learned_plan(tmp_path, "a", swapped)
    with pytest.raises(PlanningError, match=r"no learned plan '\.\./a' .* only: a"):
        learned_plan(tmp_path, "../a", bent.limb)
    with pytest.raises(PlanningError, match="set the planner's learned_plans"):
        learned_plan("", "a", bent.limb)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("limb", None, "expected a mapping"),
        ("schema_version", 7, "schema_version 1"),
        ("tip_predicted_m", [[0.0, 0.0]], "tip_predicted_m must be finite"),
        ("differential_pressure_pa", [[0.0, 1e9]], "beyond the limb's limits"),
        ("differential_pressure_pa", [[0.0, 2e4], [0.0, -2e4]], "beyond the limb's limits"),
    ],
)
def test_a_damaged_plan_is_refused_by_name(bent, tmp_path, key, value, said):
    path = tmp_path / "a.yaml"
    write_plan(bent, path)
    content = yaml.safe_load(path.read_text())
    if key == "differential_pressure_pa":
        value = (value * len(bent.time))[: len(bent.time)]
    content[key] = value
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(PlanningError, match=said):
        read_plan(path)
    path.write_text("a: [")
    with pytest.raises(PlanningError, match=r"the plan .*a\.yaml is not valid YAML"):
        read_plan(path)


LIMB = Limb.default()
OTHER = other_limb(rest=0.04)


def planned(period, amplitude=0.6, motion="same_direction"):
    given = Motion.named(motion, amplitude=amplitude, period=period, cycles=1)
    return plan(LIMB, given, method="optimal")


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """A motion of 8 s, once after one run and once after two, beside what is no plan."""
    folder, following = tmp_path_factory.mktemp("learned"), planned(8.0)
    learner = Learner(following)
    for run in (1, 2):
        learner.add(following.time, play(following, OTHER))
        following = learner.next()
        write_plan(following, folder / f"run_{run}.yaml")
        os.utime(folder / f"run_{run}.yaml", (run, run))
    (folder / "notes.yaml").write_text("no: plan\n")
    return folder


@pytest.mark.parametrize(("period", "amplitude"), [(9.0, 0.6), (8.0, 0.5)])
def test_a_near_motion_begins_with_less_than_half_of_the_error(library, period, amplitude):
    fresh = planned(period, amplitude)
    file, learned = nearest(library, fresh)
    assert file.name == "run_2.yaml"
    begun = carried_over(fresh, learned)
    assert begun.method == "learned"
    assert begun.period == period
    assert mean_error(begun, play(begun, OTHER)) < 0.5 * mean_error(fresh, play(fresh, OTHER))
    assert np.abs(begun.differential_pressure).max() <= LIMB.pneumatics.pressure_limit


def test_what_is_far_or_of_another_limb_is_not_taken(library):
    assert nearest(library, planned(16.0)) is None
    assert nearest(library, planned(8.0, motion="opposite_direction")) is None
    assert nearest(library, replace(planned(8.0), body=RodModel(OTHER))) is None


@pytest.fixture(scope="module")
def sagging():
    """The same motion with two amplitudes, of a limb that its weight bends unevenly."""
    limb = LIMB.mounted("sideways")
    motions = [Motion.named("asynchronous", size, 8.0, 1) for size in (0.25, 0.28)]
    return [plan(limb, motion, method="projected") for motion in motions]


@pytest.mark.slow
def test_a_sagging_limb_is_not_asked_for_what_evenly_bent_segments_reach(sagging):
    first, _ = sagging
    evenly = first.body.kinematics.tip(first.bend_angles)
    assert mean_error(first, evenly) > 1e-3
    again = Correction(first).plan(first.differential_pressure, np.zeros_like(first.tip_reference))
    assert again.predicted_error < 5e-4


@pytest.mark.slow
def test_near_its_poses_the_tip_of_a_sagging_limb_is_known(sagging):
    first, second = sagging
    near, even = configure(first.body, first.reference).near(first.time), first.body.kinematics
    moved = second.tip_reference - first.tip_reference

    def missed(kinematics):
        told = kinematics.tip(second.bend_angles) - kinematics.tip(first.bend_angles)
        return np.linalg.norm(told - moved, axis=1).mean()

    assert np.linalg.norm(moved, axis=1).mean() > 1e-3
    assert missed(near) < 0.3 * missed(even)
