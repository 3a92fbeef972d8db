"""The simulated limb under gravity, carried masses and pushes, against a beam solved otherwise."""

import math
from dataclasses import replace

import numpy as np
import pytest
from limbs import plain
from scipy.optimize import brentq

from der_planner.limb import PointMass, gravity_of
from der_planner.twin import LimbTwin, Push, TwinError
from der_planner.twin.body import AXIAL_STIFFNESS, RADIUS, SHEAR_STIFFNESS
from der_planner.twin.limb_twin import ATMOSPHERE
from der_planner.twin.offline import play

pytestmark = pytest.mark.slow

REST = np.full(4, ATMOSPHERE)


def elastic(**changes: float):
    """Return hardware that is a beam of one stiffness between stiff fittings, without memory."""
    return replace(plain(bending_stiffness=0.03), **changes)


def beam_tip(hardware, gravity, payload: float = 0.0, at: float = 0.244):
    """Return the resting tip of the same beam, integrated from the tip to the clamp by shooting.

    The force in a section is the weight beyond it, whatever the shape. Stiff pieces do not bend;
    the mass of a fitting is spread over its length.
    """
    first, second = hardware.segments
    ends = np.cumsum(
        [hardware.base_fitting, first.flexible_length, hardware.connector,
         second.flexible_length, hardware.tip_fitting]
    )  # fmt: skip
    count = 1000
    step = ends[-1] / count
    middle = (np.arange(count) + 0.5) * step

    def between(low, high):
        return ((middle >= low) & (middle < high)).astype(float)

    bends = between(ends[0], ends[1]) + between(ends[2], ends[3])
    mass = np.full(count, hardware.mass_per_length)
    mass += hardware.connector_mass / hardware.connector * between(ends[1], ends[2])
    mass += hardware.tip_mass / hardware.tip_fitting * between(ends[3], ends[4])
    beyond = np.cumsum((mass * step)[::-1])[::-1] - 0.5 * mass * step + payload * (middle < at)
    force = beyond[:, None] * np.array(gravity[:2])

    def from_the_tip(tip_heading: float):
        heading, moment, tip = tip_heading, 0.0, np.zeros(2)
        for k in range(count - 1, -1, -1):
            turned = heading - 0.5 * step * bends[k] * moment / first.bending_stiffness
            along = np.array([math.cos(turned), math.sin(turned)])
            across = np.array([-along[1], along[0]])
            slope = along * (1 + along @ force[k] / AXIAL_STIFFNESS)
            slope += across * (across @ force[k]) / SHEAR_STIFFNESS
            moment += step * (slope[0] * force[k, 1] - slope[1] * force[k, 0])
            heading -= step * bends[k] * moment / first.bending_stiffness
            tip += step * slope
        return heading, tip

    tip_heading = brentq(lambda angle: from_the_tip(angle)[0], -1.5, 1.5, xtol=1e-7)
    return from_the_tip(tip_heading)[1]


@pytest.mark.parametrize(("mounting", "payload"), [("sideways", 0.02), ("10", 0.0), ("-30", 0.02)])
def test_a_resting_limb_is_the_beam_of_the_textbook(mounting, payload):
    hardware, gravity = elastic(), gravity_of(mounting)
    masses = (PointMass(0.244, payload),) if payload else ()
    twin = LimbTwin(hardware=hardware, gravity=gravity, masses=masses)
    expected = beam_tip(hardware, gravity, payload)
    sag = np.linalg.norm(expected - [0.244, 0.0])
    assert sag > 0.02
    # A polyline of eight elements a segment, and the payload over 2 mm, leave a few tenths.
    assert np.linalg.norm(twin.tip - expected) < 0.01 * sag


def test_a_mass_keeps_its_weight_and_its_place():
    hardware = elastic(drag=0.0)
    payload, at = 0.03, 0.2
    twin = LimbTwin(hardware=hardware, masses=(PointMass(at, payload),))
    bare = LimbTwin(hardware=hardware)
    mass, own, arc = twin._rod.mass, bare._rod.mass, twin._body.node_arc
    assert mass.sum() - own.sum() == pytest.approx(payload)
    assert (mass - own) @ arc == pytest.approx(payload * at)
    total = hardware.mass_per_length * 0.244 + hardware.connector_mass + hardware.tip_mass
    assert own.sum() == pytest.approx(total)


@pytest.mark.parametrize("mounting", ["hanging", "standing", "-30"])
def test_a_run_begins_at_rest_and_stays_there_until_something_happens(mounting):
    for seed, payload in ((1, 0.0), (2, 0.05)):
        masses = (PointMass(0.244, payload),) if payload else ()
        twin = LimbTwin(seed, gravity=gravity_of(mounting), masses=masses)
        rest = twin.tip
        twin.step(REST, 2.0)
        # Rest angles wander, by tenths of a degree.
        assert np.linalg.norm(twin.tip - rest) < 2e-3


def test_a_payload_put_on_at_mid_run_sags_the_limb_from_its_instant_on():
    def run(pushes=()):
        instants = np.arange(60) * 0.05
        return play(instants, np.zeros((60, 2)), seed=2, gravity=gravity_of("30"), pushes=pushes)

    plain, loaded = run(), run([Push(1.02, 0.244, mass=0.02)])
    np.testing.assert_array_equal(loaded.tip[:21], plain.tip[:21])
    assert plain.tip[-1, 1] - loaded.tip[-1, 1] > 0.01
    # For 0.5 s only, the limb swings back.
    short = run([Push(1.02, 0.244, mass=0.02, duration=0.5)])
    np.testing.assert_array_equal(short.tip[:31], loaded.tip[:31])
    assert np.linalg.norm(short.tip[-1] - loaded.tip[-1]) > 5e-3


def test_gravity_across_the_plane_sags_the_limb_out_of_it():
    hardware = elastic()
    twin = LimbTwin(hardware=hardware, gravity=(0.0, 0.0, -1.7))
    level = LimbTwin(hardware=hardware, gravity=(0.0, -1.7, 0.0))
    # Round limbs are as stiff one way as the other.
    assert twin._rod.position_collection[2, -1] == pytest.approx(level.tip[1], rel=0.02)
    assert twin.tip[1] == 0.0


def test_a_peg_holds_the_limb_with_the_force_that_would_hold_it_there():
    pressure = REST + 6e3 * np.array([1.0, 0.0, 1.0, 0.0])
    free, held, pushed = (LimbTwin(hardware=elastic(drag=8.0)) for _ in range(3))
    free.step(pressure, 3.0)
    # Amid an element: contact is shared between its nodes by halves, wherever it is.
    arc = free._body.node_arc[13:15].mean()
    place = int(np.argmin(np.abs(free.shape().arc_length - arc)))
    shape, radius = free.shape(), 0.01
    normal = np.array([-math.sin(shape.heading[place]), math.cos(shape.heading[place])])
    held.put_pegs([*(shape.points[place] + (RADIUS + radius - 0.008) * normal), radius])
    held.step(pressure, 3.0)
    clearance = np.linalg.norm(held.shape().points - held._pegs.centre[0, :2], axis=1).min()
    assert clearance == pytest.approx(RADIUS + radius, abs=2e-4)
    force = -held._pegs.force.sum(axis=0)[:, 0]
    assert force[:2] @ normal < -0.1
    # What presses at that place instead of the peg leads to the same shape.
    near = held.shape()
    touched = np.argmin(np.linalg.norm(near.points - held._pegs.centre[0, :2], axis=1))
    pushed.push(Push(0.0, near.arc_length[touched], (*force[:2], 0.0)))
    pushed.step(pressure, 3.0)
    moved = np.linalg.norm(free.tip - held.tip)
    assert np.linalg.norm(pushed.tip - held.tip) < 0.03 * moved
    with pytest.raises(TwinError, match="stands where the limb"):
        free.put_pegs([0.1, 0.0, 0.01])


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"masses": (PointMass(0.3, 0.02),)}, r"0\.3 m is not on the limb"),
        ({"gravity": (0.0, math.nan, 0.0)}, "gravity"),
    ],
)
def test_impossible_loads_are_refused(changes, match):
    with pytest.raises(TwinError, match=match):
        LimbTwin(0, **changes)
    with pytest.raises(TwinError, match="to take"):
        LimbTwin(0).push(Push(0.0, 0.244, mass=-1.0))
    for strong in ({"mass": 20.0}, {"force": (0.0, 300.0, 0.0)}):
        with pytest.raises(TwinError, match="times the limb's weight"):
            LimbTwin(0).push(Push(0.0, 0.244, **strong))
