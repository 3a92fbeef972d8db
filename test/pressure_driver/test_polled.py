"""Boards that are asked: how a terminal is started, its registers, and coarse sensors."""

import asyncio
import struct
import threading

import numpy as np
import pytest
from domain import free_port
from pymodbus.client import ModbusTcpClient
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice
from waiting import Clock, wait_for

from pressure_driver.emulator import BoardReading
from pressure_driver.emulator.firmware import FestoBoard, PneudriveBoard
from pressure_driver.lines import Line
from pressure_driver.protocols import BoardFailure, Echo, Telemetry, festo, host_protocol
from pressure_driver.safety import Mode
from pressure_driver.settings import EmulatorSettings, Settings

RUNNING = 3 | 2 << 6
ROOM = 101_325.0


def answer(host, *words):
    """Have a terminal say what its registers hold."""
    data = festo.to_bytes(words)
    return host.decode(festo.encode(7, festo.READ, bytes([len(data)]) + data))


def told(data):
    """Return first register and words of a write, which is alone: servers lose a second request."""
    (write,) = festo.cut_frames(bytearray(data))
    first, count = struct.unpack(">HH", write.data[:4])
    words = festo.to_words(write.data[5:])
    assert len(words) == count
    return first, words


# --------------------------------------------------------------------------------- terminals


def test_setpoints_of_a_motion_terminal_stand_behind_the_mode_of_their_slot():
    host = host_protocol(Settings(protocol="festo"))
    data = host.setpoint([7_540.0, 0.0, 0.0, 20_000.0])
    assert told(data) == (40003, (0xC3, 75, 0, 0xC3, 0, 200))
    assert host.follow_up() == b""
    number = host.number
    assert host.decode(festo.encode(number, festo.WRITE, struct.pack(">HH", 40003, 6))) == [
        Echo(number)
    ]
    assert host.follow_up()[7:] == struct.pack(">BHH", festo.READ, 45395, 6)
    assert host.follow_up() == b""


def test_slots_are_acknowledged_for_half_a_second_before_they_are_started():
    host = host_protocol(Settings(protocol="festo"))
    clock = host.clock = Clock()

    def mode():
        return told(host.vent())[1][0]

    host.start()
    assert mode() == 0xC3, "a terminal that runs already is vented first"
    answer(host, 1 << 6, 0, 0, 1 << 6, 0, 0)
    assert "slot 0 does not run: mode 0" in host.unsettled
    host.start()
    assert mode() == 62 | 1 << 6
    answer(host, 61 | 1 << 6, 0, 0, 61 | 1 << 6, 0, 0)
    assert mode() == 62 | 1 << 6
    clock.now += 0.5
    answer(host, 61 | 1 << 6, 0, 0, 61 | 1 << 6, 0, 0)
    assert mode() == 0xC3
    answer(host, 3, 0, 0, RUNNING, 0, 0)
    assert "slot 0 does not run: mode 3, state 0 (not ready)" in host.unsettled
    # It is given twenty seconds to start, and then another turn.
    clock.now += 19.0
    host.start()
    assert mode() == 0xC3
    clock.now += 1.0
    host.start()
    assert mode() == 62 | 1 << 6
    assert answer(host, RUNNING, -3, 75, RUNNING, 0, 200) == [
        Telemetry(chamber_pressure=(ROOM - 300.0, ROOM + 7_500.0, ROOM, ROOM + 20_000.0))
    ]
    assert host.unsettled == ""


def test_a_slot_that_ceases_to_run_is_a_failure_once():
    host = host_protocol(Settings(protocol="festo"))
    answer(host, RUNNING, 0, 0, RUNNING, 0, 0)
    events = answer(host, RUNNING, 0, 0, 9 << 8 | 3 << 6 | 3, 0, 0)
    assert events[0] == BoardFailure("slot 1 does not run: mode 3, state 3 (failed), application 9")
    assert len(answer(host, RUNNING, 0, 0, 9 << 8 | 3 << 6 | 3, 0, 0)) == 1


def test_a_refusal_of_the_terminal_is_named():
    host, board = host_protocol(Settings(protocol="festo", segment_count=4)), FestoBoard(4)
    commands = board.decode(host.vent())
    reading = BoardReading(0.0, (ROOM,) * 4, ROOM, (0.0,) * 4, 0.0)
    (event,) = host.decode(b"".join(board.reply(command, reading) for command in commands))
    assert isinstance(event, BoardFailure)
    assert "a write of registers, exception 2; look at 'terminal'" in event.text


def test_a_terminal_with_regulators_is_played(simulate):
    sim = simulate("festo", terminal="mpa")
    sim.arm()
    sim.stream(4.0)
    assert sim.mode is Mode.TRACKING, sim.faults
    assert sim.gauge[0] > 2_000.0
    first, words = told(sim.sent[-1])
    assert (first, len(words)) == (40003, 4)
    assert all(word >= 0 for word in words)


def test_a_diagnosis_of_a_regulator_is_a_failure():
    host = host_protocol(Settings(protocol="festo", terminal="mpa"))
    answer(host, *(0, 0, 0) * 4)
    assert host.unsettled == ""
    failure, _ = answer(host, *(0, 0, 0) * 3, 0, 0, 5)
    assert failure == BoardFailure("valve 3 reports: diagnosis 5")


# -------------------------------------------------------------------------------- pneudrive


def test_frames_of_a_pneudrive_board():
    host = host_protocol(Settings(protocol="pneudrive"))
    data = host.setpoint([68_950.0, 0.0, 0.0, 0.0])
    assert data == bytes.fromhex("ffff 00b8 0066 0066 0066")
    assert host.setpoint([1e6, 0.0, 0.0, 0.0])[2:4] == (1023).to_bytes(2, "big")
    (reading,) = [
        event
        for event in host.decode(bytes.fromhex("ffff 00b8 0066 0066 0066"))
        if isinstance(event, Telemetry)
    ]
    assert reading.chamber_pressure == pytest.approx((ROOM + 68_950.0, ROOM, ROOM, ROOM), abs=700.0)


def test_a_pneudrive_board_answers_to_its_own_number_alone():
    host = host_protocol(Settings(protocol="pneudrive", device=2))
    data = host.setpoint([68_950.0, 0.0, 0.0, 0.0])
    assert data == bytes.fromhex("fffd 00b8 0066 0066 0066")
    board = PneudriveBoard(4)
    assert board.decode(data) == []
    board.configure(EmulatorSettings(protocol="pneudrive", device=2))
    (command,) = board.decode(data)
    assert command.pressure == pytest.approx((68_950.0, 0.0, 0.0, 0.0), abs=700.0)


def test_a_limb_on_coarse_sensors_is_armed_and_played(simulate):
    """A count is 0.84 kPa: readings at rest flicker by one."""
    sim = simulate("pneudrive", leak_tolerance=2_500.0, sensor_range=689_500.0)
    sim.arm()
    sim.stream(20.0)
    assert sim.mode is Mode.TRACKING
    assert np.max(sim.gauge) > 500.0


@pytest.fixture
def plain_server():
    """Address of a Modbus TCP server that has the registers of two slots and no others."""
    said = [RUNNING, 0, 75, RUNNING, 0xFFFF, 200]
    blocks = [
        SimData(40003, values=[0] * 6, datatype=DataType.REGISTERS),
        SimData(45395, values=said, datatype=DataType.REGISTERS, readonly=True),
    ]
    address = ("127.0.0.1", free_port())
    loop = asyncio.new_event_loop()
    server = None

    async def serve():
        nonlocal server
        server = ModbusTcpServer(SimDevice(0, simdata=blocks), address=address)
        await server.serve_forever(background=True)

    loop.run_until_complete(serve())
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    yield address
    asyncio.run_coroutine_threadsafe(server.shutdown(), loop).result(10.0)
    loop.call_soon_threadsafe(loop.stop)
    thread.join(10.0)
    loop.close()


@pytest.mark.slow
def test_registers_are_where_a_plain_server_has_them(plain_server):
    host = host_protocol(Settings(protocol="festo"))
    line = Line("tcp://{}:{}".format(*plain_server))
    events = []
    try:
        line.write(host.setpoint([7_500.0, 0.0, 0.0, 20_000.0]))
        number = host.number

        def answered():
            events.extend(host.decode(line.read()))
            line.write(host.follow_up())
            return len(events) == 2

        wait_for(answered, "both answers", 10.0)
    finally:
        line.close(drop=False)
    assert events == [
        Echo(number),
        Telemetry(chamber_pressure=(ROOM, ROOM + 7_500.0, ROOM - 100.0, ROOM + 20_000.0)),
    ]
    assert host.rejected == 0
    with ModbusTcpClient(plain_server[0], port=plain_server[1]) as other:
        assert other.read_holding_registers(40003, count=6).registers == [0xC3, 75, 0, 0xC3, 0, 200]
