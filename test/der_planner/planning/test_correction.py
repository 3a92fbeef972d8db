"""A motion that begins from what a near one has learned."""

import os
from dataclasses import replace

import numpy as np
import pytest
from limbs import mean_error, other_limb, play

from der_planner.control import Learner
from der_planner.limb import Limb
from der_planner.model import RodModel
from der_planner.planning import Motion, plan
from der_planner.planning.configuration import configure
from der_planner.planning.correction import Correction, carried_over, nearest
from der_planner.planning.plan_file import write_plan

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
