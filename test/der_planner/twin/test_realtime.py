"""The loop that keeps the simulation in step with the clock, on a clock of its own."""

import pytest

from der_planner.twin.limb_twin import BACKLOG, RealTimeLoop


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
