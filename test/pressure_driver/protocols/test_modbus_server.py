"""A terminal's registers are where a Modbus server has them that knows nothing of valves."""

import asyncio
import socket
import threading

import pytest
from pymodbus.client import ModbusTcpClient
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice
from waiting import wait_for

from pressure_driver.lines import Line
from pressure_driver.protocols import Echo, Telemetry, host_protocol
from pressure_driver.settings import Settings

RUNNING = 3 | 2 << 6
ROOM = 101_325.0


@pytest.fixture
def plain_server():
    """Address of a Modbus TCP server that has the registers of two slots and no others."""
    said = [RUNNING, 0, 75, RUNNING, 0xFFFF, 200]
    blocks = [
        SimData(40003, values=[0] * 6, datatype=DataType.REGISTERS),
        SimData(45395, values=said, datatype=DataType.REGISTERS, readonly=True),
    ]
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = free.getsockname()
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
