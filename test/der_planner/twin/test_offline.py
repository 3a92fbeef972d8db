"""Pressures played on the twin without ROS, and the loop that keeps it in step with the clock."""

import numpy as np
import pytest

from der_planner.model.air import pair_of
from der_planner.twin import TwinError
from der_planner.twin.limb_twin import BACKLOG, RealTimeLoop
from der_planner.twin.offline import LEAD, play
from pressure_driver.emulator.pneumatics import BoardPneumatics


def test_rows_are_what_was_before_the_setpoint():
    time = np.arange(40) * 0.05
    pressure = np.zeros((40, 2))
    pressure[10:, 0] = 6000.0
    result = play(time, pressure, seed=2)
    assert result.tip.shape == (40, 2)
    assert result.bend_angles.shape == result.measured_differential.shape == (40, 2)
    assert result.chamber_pressure.shape == (40, 4)
    still = result.bend_angles[:11]
    assert np.abs(still - still[0]).max() < np.deg2rad(0.2)
    np.testing.assert_allclose(result.measured_differential[:11], 0.0, atol=1e-9)
    assert result.bend_angles[-1, 0] > still[0, 0] + np.deg2rad(5.0)


def test_limb_feels_the_boards_pneumatics():
    time = np.arange(30) * 0.05
    pressure = np.tile([0.0, -4000.0], (30, 1))
    result = play(time, pressure, seed=3)
    air = BoardPneumatics(2, 3)
    for _ in range(round(LEAD / 0.01)):
        air.step(0.01)
    expected = []
    for row in pressure:
        expected.append(air.pressure)
        air.command(air.atmosphere + pair_of(row).ravel())
        for _ in range(5):
            air.step(0.01)
    np.testing.assert_allclose(result.chamber_pressure, expected, rtol=1e-12)


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
