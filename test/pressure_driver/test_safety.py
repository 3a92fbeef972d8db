"""Every refusal and every fault, in simulated time, for limbs of any pressure."""

import functools
import re
from dataclasses import replace

import numpy as np
import pytest

from pressure_driver.protocols import NAMES, Telemetry, host_protocol
from pressure_driver.safety import Mode
from pressure_driver.schedule import Verdict
from pressure_driver.settings import Settings, declarations
from pressure_driver.telemetry import TelemetryMonitor

# --------------------------------------------------------------------------------- refusals


def test_nothing_but_vent_is_sent_until_armed(simulate):
    sim = simulate()
    for index in range(40):
        assert sim.offer((1_000.0, 0.0), index=index) is Verdict.REFUSED
        sim.tick()
    assert all(sim.is_vent(data) for data in sim.sent)
    assert sim.core.machine.schedule.counts["refused"] == 40


# ------------------------------------------------------------------------------------ faults

FAULTS = {
    "telemetry stops": ("mute", "no telemetry", 0.6),
    "valve sticks": ("stick:0", "chamber 0 does not follow", 6.0),
    "leak": ("leak:0:30", "chamber 0 does not follow", 6.0),
    "supply low": ("supply:105000", "supply too low", 0.8),
    "supply high": ("supply:300000", "supply too high", 0.8),
    "valve stays open": ("runaway:1", "over-pressure|chamber 1 does not follow", 6.0),
    "board is deaf": ("deaf", "does not|expired|has not answered|no telemetry", 6.0),
}


def swing(t, pulsation=1.2):
    return (9_000.0 * np.cos(pulsation * t), -5_000.0)


@pytest.mark.parametrize(
    ("protocol", "name"),
    # Other boards do not tell their supply.
    [(p, n) for p in NAMES for n in FAULTS if p in ("ezloop", "native") or "supply" not in n],
)
def test_every_fault_ends_vented(simulate, protocol, name):
    fault, reason, limit = FAULTS[name]
    sim = simulate(protocol)
    sim.track()
    sim.have(fault)
    # A leak shows while a chamber is to be kept full.
    shape = functools.partial(swing, pulsation=0.0 if name == "leak" else 1.2)
    assert sim.play_until_fault(limit, shape, "push") <= limit
    assert any(part in " ".join(sim.faults) for part in reason.split("|")), sim.faults
    sim.tick()
    assert sim.is_vent(sim.sent[-1])
    assert sim.offer((0.0, 0.0)) is Verdict.REFUSED
    sim.run(1.0)
    assert all(sim.is_vent(data) for data in sim.sent[-19:])
    assert sim.mode is Mode.FAULT
    # Chambers that still obey are empty within four seconds; the broken ones once they work again.
    if name in ("telemetry stops", "supply low", "supply high"):
        sim.run_until(lambda: sim.vented, 3.0)
    sim.have()
    sim.run_until(lambda: sim.vented, 8.0)
    assert sim.mode is Mode.FAULT, "must stay until armed"
    sim.run_until(lambda: sim.core.arm()[0], 5.0)
    assert sim.mode is Mode.ARMED


def test_over_pressure_needs_two_readings_in_a_row(simulate):
    sim = simulate()
    sim.arm()
    sim.core.received(b"[MPR]: 1400.00 1013.00 1013.00 1013.00\n")
    sim.tick()
    assert sim.mode is Mode.ARMED
    sim.core.received(b"[MPR]: 1400.00 1013.00 1013.00 1013.00\n" * 2)
    sim.tick()
    assert sim.mode is Mode.FAULT
    assert "over-pressure in chamber 0" in sim.faults[0]


@pytest.mark.parametrize("protocol", NAMES)
def test_over_pressure_is_noticed_while_disarmed(simulate, protocol):
    sim = simulate(protocol)
    sim.run(1.5)
    sim.have("runaway:2")
    sim.run_until(lambda: sim.mode is Mode.FAULT, 8.0)


@pytest.mark.parametrize("protocol", NAMES)
def test_an_unplug_vents_after_the_reconnect_and_wants_arming(simulate, protocol):
    sim = simulate(protocol)
    sim.track()
    sim.plugged = False
    sim.core.lost("serial link lost: pulled")
    assert sim.play_until_fault(1.0, swing, "push")
    assert sim.faults == ("serial link lost: pulled",)
    sim.plugged = True
    greeting = sim.core.opening()
    assert sim.is_vent(greeting)
    sim._receive(greeting)
    sim.run_until(lambda: sim.vented, 6.0)
    assert sim.mode is Mode.FAULT
    sim.run_until(lambda: sim.core.arm()[0], 5.0)


@pytest.mark.parametrize("protocol", ["native", "festo"])
def test_a_board_with_a_watchdog_vents_by_itself_when_the_driver_dies(simulate, protocol):
    sim = simulate(protocol, command_validity=0.25)
    sim.track()
    assert sim.gauge.max() > 4_000.0
    begin = sim.board._time
    while not sim.vented:
        sim.board.step(0.05)
        assert sim.board._time - begin < 5.0
    # What it says about it, or is asked, is a fault for a driver that is back.
    sim.core.received(sim.board.telemetry())
    sim.tick()
    assert sim.mode is Mode.FAULT
    assert re.search("expired|does not run", sim.faults[0])


@pytest.mark.parametrize("protocol", ["ezloop", "ctrlp", "pneudrive", "festo"])
def test_boards_without_a_watchdog_keep_the_pressure_which_the_diagnostics_say(simulate, protocol):
    """A terminal, if function 4402 is not as it is delivered."""
    sim = simulate(protocol)
    sim.have("hold")
    sim.track()
    sim.board.step(5.0)
    assert sim.gauge.max() > 4_000.0
    assert any("this computer dies" in text for text in sim.core.protocol.weaknesses)


def test_a_board_with_other_chambers_or_less_range_cannot_be_armed(simulate):
    from pressure_driver.emulator.firmware import NativeBoard

    sim = simulate("native")
    sim.board.protocol = NativeBoard(4, largest_pressure=20_000)
    sim.run(1.5)
    sim._receive(sim.core.opening())
    sim.run(1.5)
    success, text = sim.core.arm()
    assert not success
    assert "reaches 20000 Pa" in text
    identity = replace(sim.core.board.identity, chamber_count=6, largest_pressure=3e4)
    sim.core.board.identity = identity
    assert "6 chambers" in sim.core.arm()[1]


def test_a_slow_native_board_is_asked_again(simulate):
    sim = simulate("native")
    sim.have("deaf")
    sim._receive(sim.core.opening())
    sim.run(0.5)
    assert "introduced" in sim.core.arm()[1]
    sim.have()
    sim.run_until(lambda: sim.core.arm()[0], 3.0)
    assert sim.core.board.identity.firmware == "emulator 1"


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("protocol", NAMES)
def test_no_false_alarm_on_full_steps_and_fast_swings(simulate, protocol, seed):
    """Steps over the whole range and a 3 s swing, on limbs whose valves differ."""
    sim = simulate(protocol, seed=seed, slew_limit=1e6)
    sim.arm()
    step = 20_000.0
    sim.stream(16.0, lambda t: (step if t % 8.0 < 4.0 else -step, -step if t % 6.0 < 3.0 else 0.0))
    amplitude = 18_000.0
    swing = 2.0 * np.pi / 3.0
    sim.run_until(lambda: sim.mode is Mode.ARMED)
    sim.stream(9.0, lambda t: (amplitude * np.sin(swing * t), -amplitude * np.sin(swing * t)))
    assert sim.faults == ()


def test_corrupt_lines_do_not_end_a_run(simulate):
    """Two bytes in a thousand damaged on a line without a checksum."""
    sim = simulate("ezloop")
    sim.arm()
    sim.have("corrupt:0.002")
    sim.stream(30.0)
    assert sim.mode is Mode.TRACKING
    assert sim.core.protocol.rejected > 10


@pytest.mark.parametrize("step", [-3600, -2, 2, 3600])
@pytest.mark.parametrize("protocol", NAMES)
def test_a_wall_clock_that_is_set_drops_the_schedule_and_ends_vented(simulate, protocol, step):
    sim = simulate(protocol, horizon=60.0)
    sim.track()
    held = sim.core.state()["commanded_differential"]
    for index in range(100):
        assert sim.offer(held, ahead=0.25 + 0.05 * index, plan_id="next") is Verdict.ACCEPTED
    sim.run(1.0)
    sim.clock_error = step * 1_000_000_000
    begin = sim.steady
    sim.run_until(lambda: sim.mode is Mode.ARMED, 4.0)
    assert sim.steady - begin > 1.0
    sim.run_until(lambda: sim.vented, 5.0)
    sim.run(8.0)
    assert sim.mode is Mode.ARMED, "no setpoint of the old clock may come back"
    # Setpoints in the new time are played.
    assert sim.offer((1_000.0, 0.0), plan_id="new") is Verdict.ACCEPTED
    sim.run_until(lambda: sim.mode is Mode.TRACKING, 0.3)


@pytest.mark.parametrize("protocol", NAMES)
@pytest.mark.parametrize("fault", ["drop:0.2", "corrupt:0.005"])
def test_a_bad_line_still_ends_vented(simulate, protocol, fault):
    """A fifth of the commands lost, or one byte in two hundred damaged, both ways."""
    sim = simulate(protocol, seed=3)
    sim.track()
    sim.have(fault)
    sim.core.vent()
    sim.run(8.0)
    assert sim.vented


LIMITS = (4_000.0, 24_000.0, 100_000.0, 250_000.0)
CASES = [
    (protocol, limit)
    for protocol in ("ezloop", "ctrlp", "native", "festo")
    for limit in LIMITS
    if (protocol, limit) != ("ezloop", 250_000.0)  # more than it can be told
]


def rise(limit):
    return lambda t: (0.6 * min(t / 2.0, 1.0) * limit, -0.4 * min(t / 2.0, 1.0) * limit)


def swing_of(limit):
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
    sim.stream(9.0, swing_of(limit))
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


def test_over_pressure_is_seen_where_it_is_beyond_what_a_usual_limb_may_read():
    settings = Settings(protocol="native", pressure_limit=300_000.0)
    monitor = TelemetryMonitor(host_protocol(settings), settings)
    for now in (0.0, 0.05):
        reading = (101_325.0 + 400_000.0, 101_325.0, 101_325.0, 101_325.0)
        monitor.receive(Telemetry(reading, supply_pressure=500_000.0), now, resting=False)
    assert "over-pressure in chamber 0" in next(monitor.conditions(0.05)).text


@pytest.mark.parametrize(
    ("protocol", "reach"), [("ezloop", 125_000), ("ctrlp", 500_000), ("festo", 700_000)]
)
def test_a_board_that_cannot_be_told_the_limit_is_not_armed(simulate, protocol, reach):
    sim = simulate(protocol, pressure_limit=1.2 * reach)
    sim.run(3.0)
    assert f"reaches {reach} Pa" in sim.core.arm()[1]
