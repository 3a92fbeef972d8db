"""Every transition of the state machine, and what arming waits for, in simulated time."""

import numpy as np
import pytest

from pressure_driver.protocols import NAMES
from pressure_driver.safety import Mode
from pressure_driver.schedule import Verdict


@pytest.mark.parametrize("protocol", NAMES)
def test_a_whole_life(simulate, protocol):
    sim = simulate(protocol)
    assert sim.mode is Mode.DISARMED
    sim.arm()
    assert sim.mode is Mode.ARMED
    sim.stream(4.0)
    # The stream has ended 0.2 s before its last stamp.
    sim.run_until(lambda: sim.mode is not Mode.TRACKING)
    sim.run_until(lambda: sim.mode is not Mode.HOLDING)
    sim.run_until(lambda: sim.mode is not Mode.VENTING)
    sim.run_until(lambda: sim.vented, 10.0)
    assert sim.modes_since(0) == [
        Mode.DISARMED, Mode.ARMED, Mode.TRACKING, Mode.HOLDING, Mode.VENTING, Mode.ARMED,
    ]  # fmt: skip
    counters = sim.core.machine.schedule.counts
    assert counters["accepted"] == counters["executed"] == 80
    assert counters["late"] == counters["refused"] == counters["duplicate"] == 0
    assert sim.core.vent()[0]
    sim.run_until(lambda: sim.mode is Mode.DISARMED, 10.0)
    assert sim.is_vent(sim.sent[-1])


@pytest.mark.parametrize("protocol", NAMES)
def test_each_setpoint_is_on_the_wire_at_its_stamp(simulate, protocol):
    sim = simulate(protocol)
    sim.arm()
    wanted = {}
    for index in range(100):
        u = (6_000.0 * np.sin(0.03 * index) ** 2 + 100.0, -40.0 * index - 50.0)
        wanted[sim.wall + 4 * 50_000_000] = u
        sim.offer(u, index=index)
        sim.tick()
    sim.run(0.2)
    got = {stamp: np.array(pressure) for stamp, pressure in sim.received}
    step = max(1.1, sim.core.protocol.resolution)
    for stamp, u in wanted.items():
        pressure = got[stamp]
        assert pressure[0::2] - pressure[1::2] == pytest.approx(u, abs=step)


@pytest.mark.parametrize("protocol", NAMES)
def test_holding_keeps_the_last_pressures_for_the_hold_time(simulate, protocol):
    sim = simulate(protocol, setpoint_timeout=0.2, hold_time=1.0)
    sim.track()
    last = None
    silence = 0
    while sim.mode in (Mode.TRACKING, Mode.HOLDING):
        setpoint = sim.core.machine.schedule.current
        if setpoint.stamp == last:
            silence += 1
            assert sim.core.machine.differential == setpoint.differential
        last = setpoint.stamp
        sim.tick()
    assert silence * 0.05 == pytest.approx(1.2, abs=0.06)


@pytest.mark.parametrize("protocol", NAMES)
def test_the_ramp_down_is_as_fast_as_it_says_and_keeps_the_shape(simulate, protocol):
    sim = simulate(protocol, vent_rate=8_000.0)
    sim.track()
    sim.run_until(lambda: sim.mode is Mode.VENTING)
    commanded = [sim.core.state()["commanded_differential"]]
    while sim.mode is Mode.VENTING:
        sim.tick()
        commanded.append(sim.core.state()["commanded_differential"])
    commanded = np.array(commanded)
    largest = np.abs(commanded).max(axis=1)
    assert np.diff(largest)[:-1] == pytest.approx(-400.0)
    assert commanded[-1].tolist() == [0.0, 0.0]
    ratio = commanded[:-1, 1] / commanded[:-1, 0]
    assert ratio == pytest.approx(ratio[0])


@pytest.mark.parametrize("mode", [Mode.HOLDING, Mode.VENTING])
def test_holding_and_the_ramp_down_go_on_with_the_next_setpoint(simulate, mode):
    sim = simulate()
    sim.track()
    sim.run_until(lambda: sim.mode is mode)
    held = sim.core.state()["commanded_differential"]
    assert sim.offer(held, plan_id="next") is Verdict.ACCEPTED
    sim.run_until(lambda: sim.mode is Mode.TRACKING, 0.3)


@pytest.mark.parametrize("protocol", NAMES)
@pytest.mark.parametrize("mode", [Mode.ARMED, Mode.TRACKING, Mode.HOLDING, Mode.VENTING])
def test_vent_works_in_every_live_state_and_is_latched(simulate, protocol, mode):
    sim = simulate(protocol)
    if mode is Mode.ARMED:
        sim.arm()
    else:
        sim.track()
        sim.run_until(lambda: sim.mode is mode)
    assert sim.core.vent()[0]
    assert sim.mode is Mode.VENTING
    assert sim.offer((1_000.0, 0.0)) is Verdict.REFUSED
    if mode is not Mode.ARMED:
        assert "not vented yet" in sim.core.arm()[1]
    sim.tick()
    assert sim.is_vent(sim.sent[-1])
    sim.run_until(lambda: sim.mode is Mode.DISARMED, 6.0)
    assert sim.vented
    assert sim.offer((1_000.0, 0.0)) is Verdict.REFUSED
    assert "arm first" in sim.core.machine.schedule.reason
    sim.arm()


def test_vent_while_disarmed_or_in_fault_vents_and_changes_nothing(simulate):
    sim = simulate()
    sim.run_until(lambda: sim.core.vent()[0], 2.0)  # from the board's first telemetry on
    assert sim.mode is Mode.DISARMED
    sim.track()
    sim.core.lost("pulled")
    sim.tick()
    assert sim.mode is Mode.FAULT
    heard, said = sim.core.vent()
    assert not heard
    assert "close the valve at the air supply: pulled" in said
    assert sim.mode is Mode.FAULT
    assert sim.faults == ("pulled",)


@pytest.mark.parametrize("protocol", NAMES)
def test_a_vent_that_does_not_empty_the_chambers_is_a_fault(simulate, protocol):
    sim = simulate(protocol, vent_timeout=1.0)
    sim.track()
    sim.have("stick:0")
    sim.core.vent()
    sim.run_until(lambda: sim.mode is Mode.FAULT, 5.0)
    assert "not vented" in sim.faults[0]


def test_arming_waits_for_telemetry_rest_and_empty_chambers(simulate):
    sim = simulate()
    assert "telemetry" in sim.core.arm()[1]
    sim.tick()
    assert "rest pressures" in sim.core.arm()[1]
    sim.arm()
    sim.stream(3.0)
    sim.core.lost("pulled")
    sim.tick()
    assert sim.core.arm() == (False, "not armed: pulled")
    sim.core.opening()
    sim.tick()
    success, text = sim.core.arm()
    assert not success
    assert "not vented yet" in text
    sim.run_until(lambda: sim.core.arm()[0], 6.0)
    assert sim.faults == ()


@pytest.mark.parametrize("seed", range(2))
def test_rest_pressures_are_the_sensors_own(simulate, seed):
    sim = simulate(seed=seed)
    sim.arm()
    reading = sim.board.pneumatics.pressure + sim.board._offset
    assert sim.core.monitor.rest.pressure == pytest.approx(reading, abs=8.0)


@pytest.mark.parametrize("given", [False, True])
def test_a_driver_that_finds_the_limb_under_pressure_vents_it_without_a_false_alarm(
    simulate, given
):
    atmosphere = simulate().board.atmosphere if given else 0.0
    sim = simulate(atmosphere=atmosphere)
    sim.track()
    after_a_crash = simulate(atmosphere=atmosphere)
    after_a_crash.board = sim.board
    assert sim.gauge.max() > 8_000.0
    after_a_crash.run_until(lambda: after_a_crash.core.arm()[0], 8.0)
    assert after_a_crash.vented
    assert Mode.FAULT not in after_a_crash.modes


@pytest.mark.parametrize("protocol", NAMES)
@pytest.mark.parametrize("seconds", [0.4, 5.0])
def test_a_machine_that_stands_still_for_a_moment_ends_no_run(simulate, protocol, seconds):
    """The emulated board stands still as well: nobody has been silent."""
    sim = simulate(protocol)
    sim.track()
    sim.time += round(seconds * 1e9)
    sim.stream(1.0, lambda _: (9_000.0, -5_000.0))
    assert sim.faults == ()
    assert sim.mode is Mode.TRACKING
