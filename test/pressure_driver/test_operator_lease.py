"""The limb when its operator is lost: it holds, is let down or vents, and wants arming."""

import math

import pytest

from pressure_driver.safety import LONGEST_LEASE, Mode, OperatorLeases
from pressure_driver.schedule import Verdict

PERIOD = 1.0


def watch(sim, seconds, source="page"):
    """Play on while the operator renews the lease."""
    for _ in range(round(seconds / 0.05)):
        sim.core.machine.leases.renew(source, PERIOD, sim.core.clock())
        sim.offer((9_000.0, -5_000.0), index=sim.time // 50_000_000)
        sim.tick()


def play_on(sim, mode, limit=8.0):
    """Play on without an operator until a mode is reached; return the seconds that it took."""

    def reached():
        sim.offer((9_000.0, -5_000.0), index=sim.time // 50_000_000)
        return sim.mode is mode

    return sim.run_until(reached, limit)


@pytest.mark.parametrize(
    ("policy", "modes"),
    [
        ("hold", [Mode.HOLDING, Mode.VENTING, Mode.DISARMED]),
        ("ramp", [Mode.VENTING, Mode.DISARMED]),
        ("vent", [Mode.VENTING, Mode.DISARMED]),
    ],
)
def test_a_limb_whose_operator_is_lost_stops_as_was_chosen(simulate, policy, modes):
    sim = simulate(on_lost_operator=policy, hold_time=1.0)
    sim.track()
    watch(sim, 3.0)
    assert sim.mode is Mode.TRACKING
    held = sim.core.machine.differential
    begin, first = len(sim.modes), modes[0]
    assert play_on(sim, first) == pytest.approx(PERIOD, abs=0.11)
    if policy == "hold":
        assert sim.core.machine.differential == held
        assert play_on(sim, Mode.VENTING) == pytest.approx(1.0, abs=0.11)
    # A ramp keeps what it lets down; a vent keeps nothing.
    assert any(sim.core.machine.differential) == (policy != "vent")
    assert "the operator (page) is lost" in sim.core.machine.schedule.reason
    play_on(sim, Mode.DISARMED)
    assert sim.vented
    assert sim.modes_since(begin) == [Mode.TRACKING, *modes]
    assert sim.offer((1_000.0, 0.0), plan_id="new") is Verdict.REFUSED
    sim.arm()
    assert sim.core.state()["lost_operator"] == ""
    sim.run(2 * PERIOD)
    assert sim.mode is Mode.ARMED, "a lease ends once"


def test_an_operator_who_returns_while_the_limb_is_let_down_cannot_play_on(simulate):
    sim = simulate(vent_rate=2_000.0)
    sim.track()
    watch(sim, 0.5)
    play_on(sim, Mode.VENTING)
    watch(sim, 0.5)
    assert sim.mode is Mode.VENTING
    assert "not vented yet" in sim.core.arm()[1]
    play_on(sim, Mode.DISARMED, 12.0)


def test_an_armed_limb_at_rest_is_disarmed(simulate):
    sim = simulate(on_lost_operator="hold")
    sim.arm()
    sim.core.machine.leases.renew("page", PERIOD, sim.core.clock())
    sim.run_until(lambda: sim.mode is Mode.DISARMED, 3.0)


def test_a_lease_that_is_given_up_or_that_ended_before_arming_changes_nothing(simulate):
    sim = simulate(on_lost_operator="vent")
    sim.core.machine.leases.renew("yesterday", 0.1, sim.core.clock())
    sim.track()
    watch(sim, 0.5)
    sim.core.machine.leases.renew("page", 0.0, sim.core.clock())
    sim.stream(3.0, lambda _: (9_000.0, -5_000.0))
    assert sim.mode is Mode.TRACKING


def test_each_source_has_a_lease_of_its_own():
    leases = OperatorLeases()
    leases.renew("page", 1.0, 0.0)
    leases.renew("script", 3.0, 0.0)
    leases.renew("page", 1.0, 0.9)
    assert leases.ended(1.5) == []
    assert leases.ended(2.0) == ["page"]
    assert leases.ended(4.0) == ["script"]
    assert leases.ended(9.0) == []


@pytest.mark.parametrize("period", [-1.0, math.nan, math.inf, 2 * LONGEST_LEASE])
def test_a_promise_that_says_nothing_is_not_taken(period):
    leases = OperatorLeases()
    assert "give 0 to" in leases.renew("page", period, 0.0)
    assert str(leases) == "none"
