"""A terminal's registers are where a Modbus server has them that knows nothing of valves."""

import asyncio
import socket
import threading

import pytest
from pymodbus.datastore import (
    ModbusDeviceContext,
    ModbusSequentialDataBlock,
    ModbusServerContext,
)
from pymodbus.server import ModbusTcpServer
from waiting import wait_for

from pressure_driver.lines import TcpLine
from pressure_driver.protocols import Echo, Telemetry, host_protocol

RUNNING = 3 | 2 << 6
ROOM = 101_325.0


@pytest.fixture
def plain_server():
    """Address and registers of a Modbus TCP server that knows nothing of valves."""
    registers = ModbusDeviceContext(hr=ModbusSequentialDataBlock(1, [0] * 0xFFFF))
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = free.getsockname()
    loop = asyncio.new_event_loop()
    server = None

    async def serve():
        nonlocal server
        context = ModbusServerContext(registers, single=True)
        server = ModbusTcpServer(context, address=address)
        await server.serve_forever(background=True)

    loop.run_until_complete(serve())
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    yield "tcp://{}:{}".format(*address), registers
    asyncio.run_coroutine_threadsafe(server.shutdown(), loop).result(10.0)
    loop.call_soon_threadsafe(loop.stop)
    thread.join(10.0)
    loop.close()


@pytest.mark.slow
def test_registers_are_where_a_plain_server_has_them(plain_server):
    address, registers = plain_server
    host = host_protocol("festo")
    registers.setValues(3, 45395, [RUNNING, 0, 75, RUNNING, 0xFFFF, 200])
    line = TcpLine(address)
    events = []
    try:
        data, number = host.setpoint([7_500.0, -20_000.0], ROOM, 0.25)
        line.write(data)

        def answered():
            events.extend(host.decode(line.read()))
            return len(events) == 2

        wait_for(answered, "both answers", 10.0)
    finally:
        line.close(drop=False)
    assert events == [
        Echo(number),
        Telemetry(chamber_pressure=(ROOM, ROOM + 7_500.0, ROOM - 100.0, ROOM + 20_000.0)),
    ]
    assert registers.getValues(3, 40003, 6) == [0xC3, 75, 0, 0xC3, 0, 200]
    assert host.rejected == 0
