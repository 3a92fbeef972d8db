"""The simulated limb against the mechanics of a beam, over drawn hardware, played without ROS."""

from dataclasses import replace

import numpy as np
import pytest
from limbs import plain, with_segments

from der_planner.limb import PointMass, gravity_of
from der_planner.model.air import pair_of
from der_planner.twin import LimbTwin, TwinError
from der_planner.twin.hardware import draw
from der_planner.twin.limb_twin import ATMOSPHERE, BACKLOG, RealTimeLoop
from der_planner.twin.offline import LEAD, play
from pressure_driver.emulator.pneumatics import BoardPneumatics

REST = np.full(4, ATMOSPHERE)


def settled(twin: LimbTwin, pressure: np.ndarray, duration: float = 5.0) -> LimbTwin:
    twin.step(pressure, duration)
    return twin


@pytest.mark.parametrize(
    ("chamber", "segment", "sign"), [(0, 0, 1), (1, 0, -1), (2, 1, 1), (3, 1, -1)]
)
def test_each_chamber_bends_its_own_segment_by_moment_over_stiffness(chamber, segment, sign):
    hardware = replace(plain(), drag=6.0)
    pressure = REST.copy()
    pressure[chamber] += 8000.0
    twin = settled(LimbTwin(hardware=hardware), pressure)
    part = hardware.segments[segment]
    moment = part.chamber_gain[chamber % 2] * 8000.0
    expected = sign * moment * part.flexible_length / part.bending_stiffness
    assert twin.bend_angles[segment] == pytest.approx(expected, rel=2e-3)
    assert abs(twin.bend_angles[1 - segment]) < 1e-3
    assert np.sign(twin.tip[1]) == sign


def test_bent_limb_is_arcs_between_straight_fittings():
    hardware = replace(plain(), drag=6.0)
    pressure = REST + np.array([9000.0, 0.0, 0.0, 6000.0])
    twin = settled(LimbTwin(hardware=hardware), pressure)
    first, second = hardware.segments
    lengths = [hardware.base_fitting, first.flexible_length, hardware.connector,
               second.flexible_length, hardware.tip_fitting]  # fmt: skip
    bends = [0.0, twin.bend_angles[0], 0.0, twin.bend_angles[1], 0.0]
    position, heading = 0j, 1 + 0j
    for length, bend in zip(lengths, bends, strict=True):
        arc = 1.0 if bend == 0 else (np.exp(1j * bend) - 1) / (1j * bend)
        position += heading * length * arc
        heading *= np.exp(1j * bend)
    # The rod shears and stretches, and a polyline of eight elements is not quite an arc.
    np.testing.assert_allclose(twin.tip, [position.real, position.imag], atol=2e-4)


def test_first_frequency_is_a_cantilevers():
    hardware = replace(plain(), drag=0.05, base_fitting=5e-3, connector_mass=0.0, tip_mass=0.0)
    hardware = with_segments(hardware, bending_stiffness=0.0175)
    twin = LimbTwin(hardware=hardware)
    twin.step(REST + np.array([600.0, 0.0, 600.0, 0.0]), 0.3)
    heights = []
    for _ in range(500):
        twin.step(REST, 0.01)
        heights.append(twin.tip[1])
    wave = np.array(heights)
    crossings = np.nonzero((wave[:-1] < 0) & (wave[1:] >= 0))[0]
    instants = 0.01 * (crossings + wave[crossings] / (wave[crossings] - wave[crossings + 1]))
    frequency = 1.0 / np.diff(instants).mean()
    flexible = sum(s.flexible_length for s in hardware.segments)
    slowest = 3.516 / (2 * np.pi) * np.sqrt(0.0175 / hardware.mass_per_length / 0.244**4)
    # The stiff parts shorten what bends: the frequency lies between the whole and the flexible
    # length.
    assert slowest < frequency < slowest * (0.244 / flexible) ** 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mounting", "payload"),
    [("horizontal", 0.0), ("hanging", 0.05), ("standing", 0.05), ("sideways", 0.05)],
)
def test_stable_for_every_admissible_pressure_mounting_and_payload(mounting, payload):
    generator = np.random.default_rng(1)
    masses = (PointMass(0.244, payload),) if payload else ()
    for seed in range(2):
        twin = LimbTwin(seed, gravity=gravity_of(mounting), masses=masses)
        for _ in range(6):
            twin.step(ATMOSPHERE + generator.choice([0.0, 24_000.0, 40_000.0], 4), 0.15)
            stretch = twin._rod.lengths / twin._rod.rest_lengths
            assert 0.5 < stretch.min() < stretch.max() < 1.7
            assert np.linalg.norm(twin.tip) < 0.3
            assert np.abs(twin.shape().heading).max() < 3 * np.pi


def test_shape_is_interpolated_along_the_material():
    twin = LimbTwin(2)
    twin.step(REST + np.array([9000.0, 0.0, 0.0, 4000.0]), 1.0)
    fine = twin.shape()
    np.testing.assert_allclose(fine.points[-1], twin.tip, atol=1e-12)
    assert fine.arc_length[-1] == pytest.approx(0.244, abs=1e-12)
    steps = np.diff(fine.points, axis=0)
    chord = np.arctan2(steps[:, 1], steps[:, 0])
    middle = 0.5 * (fine.heading[1:] + fine.heading[:-1])
    assert np.abs(chord - middle).max() < np.deg2rad(2.0)


@pytest.mark.slow
def test_friction_leaves_a_loop_that_an_elastic_limb_has_not():
    def loop(twin: LimbTwin) -> float:
        at_zero, last = [], 0.0
        for height in (9000.0, 0.0, -9000.0, 0.0):
            for share in np.linspace(0.02, 1.0, 50):
                level = last + share * (height - last)
                twin.step(REST + np.array([max(level, 0.0), max(-level, 0.0), 0.0, 0.0]), 0.04)
            last = height
            twin.step(REST + np.array([max(last, 0.0), max(-last, 0.0), 0.0, 0.0]), 1.5)
            if height == 0.0:
                at_zero.append(twin.bend_angles[0])
        return abs(at_zero[0] - at_zero[1])

    rubbing = replace(draw(0), drag=4.0)
    assert np.deg2rad(0.7) < loop(LimbTwin(hardware=rubbing)) < np.deg2rad(9.0)
    assert loop(LimbTwin(hardware=replace(plain(), drag=4.0))) < np.deg2rad(0.4)


def test_pressures_in_small_steps_do_not_shake_the_friction_loose():
    # Undamped modes would ring, reverse the bend all the time, and keep friction below its full
    # value.
    twin = LimbTwin(1)
    for step in range(400):
        share = step // 2 * 2 / 400  # a board that tells its pressures every 20 ms
        level = 14_000.0 * np.sin(0.5 * np.pi * share) ** 2
        twin.step(REST + np.array([level, 0.0, 0.0, 0.0]), 0.01)
    first = twin._body.vertex_segment == 0
    assert twin._material.friction[first].min() > 0.8
    assert twin._material.friction[first].mean() > 0.9


def test_creep_goes_on_after_the_step():
    calm = replace(plain(), drag=6.0)
    creeping = with_segments(
        calm,
        creep_stiffness=lambda s: (0.0, 0.03 * s.bending_stiffness, 0.0),
        creep_time=(0.03, 5.0, 60.0),
    )
    moved = []
    for hardware in (calm, creeping):
        twin = LimbTwin(hardware=hardware)
        twin.step(REST + np.array([9000.0, 0.0, 0.0, 0.0]), 3.0)
        early = twin.bend_angles[0]
        twin.step(REST + np.array([9000.0, 0.0, 0.0, 0.0]), 4.0)
        moved.append(twin.bend_angles[0] - early)
    assert moved[1] > 5 * abs(moved[0])
    assert moved[1] > np.deg2rad(0.1)


def test_a_seed_is_a_limb():
    def run(seed: int, wander: int = 0) -> np.ndarray:
        twin = LimbTwin(seed, wander)
        for _ in range(10):
            twin.step(REST + np.array([5000.0, 0.0, 3000.0, 0.0]), 0.05)
        return twin.tip

    np.testing.assert_array_equal(run(4), run(4))
    assert np.linalg.norm(run(4) - run(5)) > 1e-4
    other = np.linalg.norm(run(4) - run(4, wander=1))
    assert 0 < other < 5e-3


@pytest.mark.parametrize(
    "pressure", [np.full(4, 4e5), np.full(3, ATMOSPHERE), np.full(4, np.nan), np.full(4, -2e5)]
)
def test_impossible_pressures_are_refused(pressure):
    with pytest.raises(TwinError, match="chamber pressures"):
        LimbTwin(0, hardware=plain()).step(pressure, 0.1)


def test_limb_feels_the_boards_pneumatics():
    time = np.arange(30) * 0.05
    pressure = np.tile([0.0, -4000.0], (30, 1))
    result = play(time, pressure, seed=3)
    air = BoardPneumatics(2, 3)
    for _ in range(round(LEAD / 0.01)):
        air.step(0.01)
    expected = []
    for row in pressure:
        expected.append(air.pressure[0::2] - air.pressure[1::2])
        air.command(air.atmosphere + pair_of(row).ravel())
        for _ in range(5):
            air.step(0.01)
    np.testing.assert_allclose(result.measured_differential, expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("time", "pressure", "match"),
    [
        ([0.0, 0.05], np.zeros((3, 2)), "expected time"),
        ([0.0, 0.0], np.zeros((2, 2)), "rise"),
        ([0.0, 0.05], np.full((2, 2), np.nan), "finite"),
        ([0.0, 0.05], np.zeros((2, 3)), "segments"),
    ],
)
def test_bad_input_is_named(time, pressure, match):
    with pytest.raises(TwinError, match=match):
        play(time, pressure)


class World:
    """A clock, and a simulation whose cost is a share of the time that it covers."""

    def __init__(self, cost: float = 0.0) -> None:
        self.now = 100.0
        self.cost = cost
        self.simulated = 0.0
        self.published: list[float] = []

    def advance(self, duration: float) -> None:
        self.simulated += duration
        self.now += duration * self.cost

    def publish(self, age: float) -> None:
        self.published.append(self.now - age)

    def run(self, loop: RealTimeLoop, duration: float) -> None:
        end = self.now + duration
        while self.now < end:
            pause = loop.tick(self.now)
            self.now += pause + 1e-6


def build(cost: float = 0.0) -> tuple[World, RealTimeLoop]:
    world = World(cost)
    return world, RealTimeLoop(world.advance, world.publish, 1 / 30, clock=lambda: world.now)


def test_simulates_what_passes_and_publishes_on_a_grid():
    world, loop = build(cost=0.1)
    world.run(loop, 10.0)
    assert world.simulated == pytest.approx(10.0, abs=0.02)
    assert len(world.published) == pytest.approx(301, abs=1)
    gaps = [b - a for a, b in zip(world.published, world.published[1:], strict=False)]
    assert max(gaps) < 1.5 / 30
    assert loop.dropped == 0.0
    assert loop.real_time_factor == 1.0


def test_catches_up_a_bounded_backlog_only():
    world, loop = build()
    world.run(loop, 1.0)
    before = world.simulated
    world.now += 5.0
    loop.tick(world.now)
    assert world.simulated - before == pytest.approx(BACKLOG)
    assert loop.dropped == pytest.approx(5.0 - BACKLOG, abs=0.02)
    assert loop.behind
    assert loop.real_time_factor < 0.5
    world.run(loop, 6.0)
    assert not loop.behind


def test_a_simulation_that_is_too_slow_says_so():
    world, loop = build(cost=2.0)
    world.run(loop, 20.0)
    assert loop.behind
    assert loop.real_time_factor < 0.7
