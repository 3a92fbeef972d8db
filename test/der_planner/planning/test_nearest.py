"""The nearest path: whatever is drawn, the limb can follow what comes out."""

from dataclasses import replace

import numpy as np
import pytest
from limbs import with_segments

from der_planner.limb import Limb
from der_planner.model import ArcModel, RodModel
from der_planner.planning import Motion, Workspace, plan
from der_planner.planning.configuration import configure

LIMB = Limb.default()
ARCS = ArcModel(LIMB)
SPACE = Workspace(RodModel(LIMB))
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
