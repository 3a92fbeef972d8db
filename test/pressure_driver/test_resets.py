"""Boards that start again, forget their settings, or stop answering while a limb is driven."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pressure_driver.core import BoardWatch
from pressure_driver.emulator import BoardReading
from pressure_driver.emulator.firmware import BOARDS
from pressure_driver.protocols import BoardReset, host_protocol
from pressure_driver.safety import Mode
from pressure_driver.settings import Settings

AT_REST = BoardReading(0.0, (101_325.0,) * 4, 101_325.0, (0.0,) * 4, 150_000.0)


@pytest.mark.parametrize("protocol", ["ezloop", "ctrlp", "native", "festo"])
@pytest.mark.parametrize("seconds", [0.1, 0.2, 0.4])
def test_a_reset_of_the_board_is_a_fault_and_does_not_refill_the_limb(simulate, protocol, seconds):
    sim = simulate(protocol)
    sim.track()
    sim.board.restart(seconds)
    sim.stream(1.0, lambda _: (9_000.0, -5_000.0))
    assert sim.mode is Mode.FAULT
    # Slots of a terminal have to be started again.
    assert re.search("has been reset|slot 0 does not run", " ".join(sim.faults))
    received = len(sim.received)
    sim.stream(4.0)
    assert sim.mode is Mode.FAULT
    assert all(
        np.ptp(np.reshape(p, (-1, 2)), axis=1).max() < 1.0 for _, p in sim.received[received:]
    )
    assert sim.vented
    if protocol == "ezloop":
        # It has taken the pressure that was left in its chambers for the room's: power it anew.
        sim.board.restart(0.1)
        sim.run(0.5)
    # Once it is set up again, it can be armed again and reaches what it is told.
    sim.track()
    assert sim.gauge.max() > 5_000.0


def test_a_ctrlp_board_that_boots_late_reports_and_gets_no_pressure_in_psi(simulate):
    sim = simulate("ctrlp")
    sim.board.restart(3.0)
    sim.run(2.0)
    assert "kPa" in " ".join(sim.core.obstacles())
    sim.track()
    assert sim.core.protocol.unsettled == ""
    assert 4_000.0 < sim.gauge.max() < 12_000.0


def test_without_the_echo_of_the_units_no_pressure_is_commanded(simulate):
    sim = simulate("ctrlp")
    sim.arm()
    sim.core.protocol.doubt()
    sim.have("echoless")
    sim.offer((3_000.0, 0.0))
    before = len(sim.sent)
    sim.run(0.6)
    assert all(sim.is_vent(data) for data in sim.sent[before:])
    sim.run(1.0)
    assert any(b"UNITS;1" in data for data in sim.sent[before:])


@pytest.mark.parametrize("protocol", ["ctrlp", "native"])
def test_echoes_that_stop_are_a_fault_within_two_seconds(simulate, protocol):
    sim = simulate(protocol)
    sim.track()
    sim.have("echoless")
    assert sim.play_until_fault(3.0, lambda _: (2_000.0, -2_000.0), "on") < 2.0
    assert "not answered" in " ".join(sim.faults)
    assert "not answered" in " ".join(sim.core.obstacles())
    sim.have()
    sim.arm()


@pytest.mark.parametrize("rate", [20.0, 100.0])
def test_a_board_that_never_echoes_is_noticed_at_any_rate(rate):
    settings = Settings(protocol="native", rate=rate)
    watch = BoardWatch(host_protocol(settings), settings)
    for number in range(int(2.0 * rate)):
        watch.has_sent(number, number / rate)
    assert "not answered a command" in " ".join(each.text for each in watch.conditions(2.0))


def test_one_damaged_report_of_a_ctrlp_board_is_no_reset():
    host = host_protocol(Settings(protocol="ctrlp"))
    host.unsettled = ""
    line = "{}\t1\t0.000\t0.000\t0.000\t0.000\n"
    for time in (10_000, 10_050, 2_100, 10_150, 90_200, 10_250, 10_300):
        events = host.decode(line.format(time).encode())
        assert not [e for e in events if isinstance(e, BoardReset)], time
    host.decode(line.format(20).encode())
    assert [e for e in host.decode(line.format(70).encode()) if isinstance(e, BoardReset)]
    assert host.unsettled


def test_echoes_and_warnings_of_a_ctrlp_board_are_no_reset():
    host = host_protocol(Settings(protocol="ctrlp"))
    board = BOARDS["ctrlp"]()
    answers = b"".join(
        board.reply(command, AT_REST)
        for command in board.decode(host.start() * 2 + host.setpoint([1e3, 0.0, 0.0, 0.0]))
    )
    events = host.decode(answers + b"_UNREC: Unrecognized Command\n")
    assert not [e for e in events if isinstance(e, BoardReset)]
    assert host.unsettled == ""
    assert [e for e in host.decode(b"_pressure controller\n") if isinstance(e, BoardReset)]


@pytest.mark.parametrize(
    ("answer", "settled"),
    [
        (b"_NEW UNITS: kPa\tkPa\r\n", True),
        (b"_UNITS: kPa\tkPa\r\n", True),
        (b"_NEW UNITS: 1\n", True),
        (b"_NEW UNITS: kPa\tpsi\r\n", False),
        (b"_NEW UNITS: 0\n", False),
    ],
)
def test_units_are_confirmed_by_name_or_number_for_commands_and_reports(answer, settled):
    host = host_protocol(Settings(protocol="ctrlp"))
    host.decode(answer)
    assert (host.unsettled == "") is settled
    assert settled or answer[1:-2].strip().decode() in host.unsettled


def test_lines_of_setpoints_and_of_the_supply_are_no_damage():
    host = host_protocol(Settings(protocol="ctrlp"))
    lines = b"50\t0\t0.00\t0.00\t0.00\t0.00\r\n50\t1\t1.00\t0.00\t0.00\t0.00\r\n50\t2\t40.00\r\n"
    _, measured, supply = host.decode(lines)
    assert host.rejected == 0
    assert measured.chamber_pressure == pytest.approx((102_325.0, 101_325.0, 101_325.0, 101_325.0))
    assert supply.supply_pressure == pytest.approx(141_325.0)


def test_the_clock_of_a_native_board_may_overflow():
    host, board = host_protocol(Settings(protocol="native")), BOARDS["native"]()

    def status(milliseconds):
        events = host.decode(board.telemetry(replace(AT_REST, time=milliseconds / 1000.0)))
        return [e for e in events if isinstance(e, BoardReset)]

    assert not status(2**32 - 60)
    assert not status(2**32 - 10)
    assert not status(2**32 + 40)
    assert not status(2**32 + 90_000)
    assert status(50)
