"""Slow leaks, boards that no longer hear, boards that start under pressure; and no false alarms."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pressure_driver.core import BoardWatch
from pressure_driver.protocols import NAMES, Echo, host_protocol
from pressure_driver.safety import Mode
from pressure_driver.settings import Settings


def steady(_):
    return (8_000.0, -5_000.0)


def rise_to_steady(sim):
    sim.arm()
    sim.stream(4.0, lambda t: tuple(min(t / 2.0, 1.0) * value for value in steady(t)))
    assert sim.mode is Mode.TRACKING


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("protocol", ["ezloop", "native"])
def test_a_leak_that_the_regulator_makes_up_for_shows_in_its_inlet_valve(simulate, protocol, seed):
    sim = simulate(protocol, seed)
    rise_to_steady(sim)
    sim.have("leak:0:0.4")
    # The pressure hardly falls: it is no matter for the following check.
    assert sim.play_until_fault(30.0, steady) < 22.0
    assert "chamber 0 loses air: its inlet valve was open" in sim.faults[0]
    assert sim.gauge.max() > 6_000.0
    sim.run(8.0)
    assert sim.vented


@pytest.mark.parametrize("protocol", NAMES)
def test_a_chamber_that_stays_a_little_below_its_command_is_a_leak(simulate, protocol):
    sim = simulate(protocol, leak_opening=1.0)
    rise_to_steady(sim)
    sim.have("leak:3:4.5")  # its regulator leaves 1.3 kPa missing
    assert sim.play_until_fault(30.0, steady) < 20.0
    assert "chamber 3 loses air" in sim.faults[0]
    assert "below its command" in sim.faults[0]


@pytest.mark.parametrize("protocol", ["ezloop", "ctrlp", "native"])
def test_telemetry_that_repeats_itself_is_a_fault_under_a_steady_command(simulate, protocol):
    """The readings stand still; on a board that tells them in coarse steps, its clock does, too."""
    sim = simulate(protocol)
    rise_to_steady(sim)
    reading = sim.board.reading()
    if protocol == "ctrlp":
        sim.board.reading = lambda: reading
    else:
        board = sim.board
        board.reading = lambda: replace(
            reading, time=board._time, last_sequence=board._sequence, vented=False
        )
    assert sim.play_until_fault(20.0, steady) < 3.0
    assert re.search("is frozen|no telemetry", sim.faults[0])
    sim.run(8.0)
    assert sim.vented


def test_rounded_readings_may_stand_still(simulate):
    sim = simulate("native", frozen_time=0.0)
    rise_to_steady(sim)
    board, reading = sim.board, sim.board.reading()
    board.reading = lambda: replace(reading, time=board._time, last_sequence=board._sequence)
    assert sim.play_until_fault(5.0, steady) is None, sim.faults


@pytest.mark.slow
@pytest.mark.parametrize("protocol", NAMES)
@pytest.mark.parametrize(("seed", "period"), [(5, 3.0), (6, 20.0)])
def test_no_motion_of_a_sound_limb_is_taken_for_a_leak(simulate, protocol, seed, period):
    sim = simulate(protocol, seed)
    sim.arm()
    rate = 2.0 * np.pi / period

    def motion(t):
        return (10_000.0 * np.sin(rate * t), 12_000.0 * (1.0 - np.cos(rate * t)) / 2.0)

    assert sim.play_until_fault(60.0, motion) is None, sim.faults


def test_a_board_that_fills_a_little_too_high_ends_vented(simulate):
    sim = simulate("ezloop")
    sim.board.atmosphere += 1_800.0  # what it took for the room's pressure
    rise_to_steady(sim)
    assert sim.play_until_fault(20.0, steady) < 16.0
    assert "filled too high" in sim.faults[0]
    assert "powered anew" in sim.faults[0]


def test_a_late_status_of_an_older_command_leaves_the_newest_waiting():
    watch = BoardWatch(host_protocol(Settings(protocol="native")), Settings())
    watch.has_sent(8, 1.00)
    watch.take_echo(Echo(7), 1.01)
    assert np.isnan(watch.round_trip)
    watch.take_echo(Echo(8), 1.02)
    assert watch.round_trip == pytest.approx(0.02)
