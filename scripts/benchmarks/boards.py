"""What each valve board does when its host dies: seconds until the emulated one is vented."""

from __future__ import annotations

import math

import numpy as np

from pressure_driver.emulator.board import EmulatedBoard, Faults
from pressure_driver.emulator.firmware import BOARDS
from pressure_driver.emulator.pneumatics import BoardPneumatics
from pressure_driver.protocols import NAMES, host_protocol

PERIOD = 0.05
"""[s] between two commands, which stay valid for five of them."""
COMMAND = (9_000.0, 0.0, 0.0, 5_000.0)
"""[Pa] when the host dies."""
VENTED = 500.0
"""[Pa] gauge."""
PATIENCE = 60.0
"""[s] after which a board counts as one that keeps its pressures."""


def seconds_until_vented(name: str, fault: str = "") -> float:
    """Return how long a board keeps pressure without a host [s]; infinity for one that does."""
    host, air = host_protocol(name), BoardPneumatics(2, 0)
    board = EmulatedBoard(BOARDS[name](), air, 0)
    board.set_faults(Faults.parse([fault], 4))
    now = 0.0
    host.clock = lambda: now
    data = host.start()
    while np.max(air.pressure) - air.atmosphere < 0.95 * max(COMMAND):
        data += host.setpoint(COMMAND, air.atmosphere, 5 * PERIOD)[0]
        while data:
            _, answer = board.receive(data, 0)
            host.decode(answer)
            data = host.follow_up()
        board.step(PERIOD)
        now += PERIOD
        if host.unsettled:
            data = host.start()
    waited = 0.0
    while np.max(air.pressure) - air.atmosphere > VENTED:
        if waited > PATIENCE:
            return math.inf
        board.step(PERIOD)
        waited += PERIOD
    return waited


def main() -> None:
    """Print the table."""
    cases = [(name, "") for name in NAMES] + [("festo", "hold")]
    for name, fault in cases:
        seconds = seconds_until_vented(name, fault)
        told = f"vented after {seconds:.1f} s" if math.isfinite(seconds) else "keeps its pressures"
        print(f"{name:10s} {fault:6s} {told}")


if __name__ == "__main__":
    main()
