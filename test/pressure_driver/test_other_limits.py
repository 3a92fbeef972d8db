"""Limbs of other pressures: given their `pressure_limit` alone, they are guarded as usual ones."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pressure_driver.protocols import Telemetry, host_protocol
from pressure_driver.safety import Mode
from pressure_driver.schedule import Verdict
from pressure_driver.settings import Settings, declarations
from pressure_driver.telemetry import TelemetryMonitor

LIMITS = (4_000.0, 24_000.0, 100_000.0, 250_000.0)
CASES = [
    (protocol, limit)
    for protocol in ("ezloop", "ctrlp", "native", "festo")
    for limit in LIMITS
    if (protocol, limit) != ("ezloop", 250_000.0)  # more than it can be told
]


def rise(limit):
    return lambda t: (0.6 * min(t / 2.0, 1.0) * limit, -0.4 * min(t / 2.0, 1.0) * limit)


def swing(limit):
    return lambda t: (0.8 * limit * np.sin(2.0 * t), -0.8 * limit * np.sin(2.0 * t))


def test_a_limit_alone_makes_the_other_pressures_and_what_is_given_stays():
    usual = Settings()
    for limit in LIMITS:
        scale = limit / usual.pressure_limit
        settings = Settings(pressure_limit=limit)
        for name in ("over_pressure", "slew_limit", "vent_rate", "slowest_fill"):
            assert getattr(settings, name) == pytest.approx(scale * getattr(usual, name))
        for name in ("follow_tolerance", "leak_tolerance", "vented_tolerance"):
            assert getattr(settings, name) == pytest.approx(
                max(scale * getattr(usual, name), 300.0)
            )
        for name in ("supply_low", "supply_high"):
            grown = 1e5 + max(scale, 1.0) * (getattr(usual, name) - 1e5)
            assert getattr(settings, name) == pytest.approx(grown)
    assert Settings(pressure_limit=4_000.0, over_pressure=30_000.0).over_pressure == 30_000.0
    assert replace(settings, wiring="3,4,1,2").over_pressure == settings.over_pressure


def test_the_usual_limit_has_the_usual_pressures():
    values = (2e5, 1e4, 3e4, 1.15e5, 2e5, 3e3, 4e3, 1e3, 500.0)
    names = [name for name, declaration, _ in declarations(Settings) if declaration.derive]
    assert tuple(getattr(Settings(), name) for name in names) == values


@pytest.mark.parametrize(("protocol", "limit"), CASES)
def test_a_sound_limb_is_played_and_let_down(simulate, protocol, limit):
    sim = simulate(protocol, 1, pressure_limit=limit)
    sim.arm()
    sim.stream(12.0, rise(limit))
    assert sim.gauge.max() == pytest.approx(0.6 * limit, rel=0.05)
    sim.run_until(lambda: sim.mode is Mode.ARMED, 3.5)
    sim.stream(9.0, swing(limit))
    assert sim.faults == ()


@pytest.mark.parametrize(
    ("fault", "reason", "longest"),
    [
        ("leak:3:4.5", "chamber 3 does not follow", 3.0),
        ("leak:3:1.2", "chamber 3 loses air", 20.0),
        ("runaway:1", "chamber 1 does not follow|over-pressure", 3.0),
    ],
)
@pytest.mark.parametrize(("protocol", "limit"), CASES)
def test_a_broken_chamber_is_noticed_as_soon(simulate, protocol, limit, fault, reason, longest):
    sim = simulate(protocol, 1, pressure_limit=limit, leak_opening=1.0)
    sim.arm()
    sim.stream(5.0, rise(limit))
    sim.have(fault)
    assert sim.play_until_fault(longest, lambda _: rise(limit)(5.0), "next") <= longest
    assert re.search(reason, sim.faults[0])
    assert sim.gauge.max() < 1.3 * limit


@pytest.mark.parametrize("limit", LIMITS)
def test_a_supply_that_is_lost_is_noticed_at_once(simulate, limit):
    sim = simulate("native", 1, pressure_limit=limit)
    sim.arm()
    sim.stream(3.0, swing(limit))
    sim.have(f"supply:{1e5 + 0.5 * limit}")
    assert sim.play_until_fault(1.0, swing(limit), "next") < 1.0
    assert "supply too low" in sim.faults[0]


@pytest.mark.parametrize("limit", LIMITS)
def test_a_jump_to_the_limit_is_refused(simulate, limit):
    sim = simulate("native", pressure_limit=limit)
    sim.arm()
    assert sim.offer((limit, 0.0), ahead=0.05) is Verdict.REFUSED
    assert "changes by" in sim.core.machine.schedule.reason


def test_over_pressure_is_seen_where_it_is_beyond_what_a_usual_limb_may_read():
    settings = Settings(protocol="native", pressure_limit=300_000.0)
    monitor = TelemetryMonitor(host_protocol(settings), settings)
    for now in (0.0, 0.05):
        reading = (101_325.0 + 400_000.0, 101_325.0, 101_325.0, 101_325.0)
        monitor.receive(Telemetry(reading, supply_pressure=500_000.0), now, resting=False)
    assert "over-pressure in chamber 0" in next(monitor.conditions(0.05)).text


def test_a_board_that_cannot_be_told_the_limit_is_not_armed(simulate):
    sim = simulate("ezloop", pressure_limit=250_000.0)
    sim.run(3.0)
    assert "reaches 125000 Pa" in sim.core.arm()[1]
