"""A Festo CPX terminal with the bus node CPX-FB36, by Modbus TCP.

Its proportional valves are a motion terminal VTEM, or VPPM regulators of an MPA terminal, as the
parameter `terminal` says. Gauge pressures are numbers of 16 bits in mbar. Every tick writes one
block of registers and reads one when the write is answered: many servers lose the second of two
requests that wait.

``vtem``: a slot has two valves, which are the pair of a segment. Slot s has three registers from
40003 + 3s on for what it is told, and three from 45395 + 3s on for what it says::

    told: mode and valves, setpoint, setpoint        says: mode and state, pressure, pressure

Bits 0 to 5 of the first are the mode: 3 regulates pressures, 61 does nothing, 62 acknowledges.
Bits 6 and 7 name the valves, or the state: 0 not ready, 1 to be configured, 2 running, 3 failed.
The high byte is the state of the application. After power-up each slot is told 62 for the first
valve, which reads back as 61, and after half a second 3 for both; it runs some seconds later.

``mpa``: valve i has one register at 40003 + i for its setpoint, and three from 45395 + 3i on:
pressure, setpoint, diagnosis. A negative setpoint would make it go wild: none is ever sent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from pressure_driver.protocols import BoardFailure, Echo, Event, HostProtocol, Telemetry, modbus

if TYPE_CHECKING:
    from pressure_driver.settings import Settings

FIRST_OUTPUT = 40003
FIRST_INPUT = 45395
INPUTS = 3
"""Registers that say something about a slot, or a valve of an MPA terminal."""
PASCAL_PER_MILLIBAR = 100.0
LARGEST_SETPOINT = 7000
"""[mbar]"""
REGULATE, INACTIVE, ACKNOWLEDGE = 3, 61, 62
FIRST_VALVE, BOTH_VALVES = 1, 3
STATES = ("not ready", "to be configured", "running", "failed")
RUNNING = 2
ACKNOWLEDGE_TIME = 0.5
"""[s] for which a slot is told to acknowledge."""
START_TIME = 20.0
"""[s] after which slots that do not run yet are started again."""
_UNKNOWN = "the valves have not said yet that they run"


def slot_word(mode: int, control: int) -> int:
    """Return the first register of a slot: a mode with valves, or with a state."""
    return mode | control << 6


class FestoHost(HostProtocol):
    """The driver's end of ``festo``."""

    name = "festo"
    weaknesses = (
        "function 4402 of the terminal must be at 'reset outputs', as it is delivered: otherwise "
        "the valves keep the last pressures if this computer dies",
        "no address is kept from other hosts: who else writes to the terminal is not noticed",
    )
    has_watchdog = True
    separator = b""
    echoes = True
    resolution = PASCAL_PER_MILLIBAR

    def __init__(self, chamber_count: int = 4) -> None:
        super().__init__(chamber_count)
        self._motion_terminal = True
        self._frames = modbus.ModbusReader()
        self._transaction = 0
        self.reset()

    def configure(self, settings: Settings) -> None:
        """Take over which valves the terminal has."""
        self._motion_terminal = settings.terminal == "vtem"

    def reset(self) -> None:
        """Forget a half-received frame and whether the valves run."""
        self._frames.reset()
        self._follow_up = b""
        self._sound = self._acknowledging = False
        self._started_at = -math.inf
        self._modes: set[int] = set()
        self.doubt()

    def doubt(self) -> None:
        """Have the valves say again that they run before the next setpoint."""
        self.unsettled = _UNKNOWN

    # ------------------------------------------------------------------------- to the terminal

    def start(self) -> bytes:
        """Have slots that do not run acknowledged by the next commands; there is nothing to send.

        They are asked first: a terminal that runs already is vented and not started again.
        """
        now = self.clock()
        if self._modes and not self._sound and now - self._started_at > START_TIME:
            self._started_at = now
            self._acknowledging = self._motion_terminal
        return b""

    def setpoint(self, gauge: Sequence[float]) -> tuple[bytes, int | None]:
        """Encode one write of all setpoints to 1 mbar; its answer brings the question."""
        millibar = (round(value / PASCAL_PER_MILLIBAR) for value in gauge)
        values = [min(max(value, 0), LARGEST_SETPOINT) for value in millibar]
        return self._write(values, self._acknowledging), self._transaction

    def emergency(self) -> bytes:
        """Regulate to the room's pressure, also where slots are being acknowledged."""
        return self._write([0] * self.chamber_count, False)

    @property
    def _places(self) -> int:
        """Slots, or valves of an MPA terminal."""
        return self.chamber_count // 2 if self._motion_terminal else self.chamber_count

    def _next(self) -> int:
        self._transaction = (self._transaction + 1) & 0xFFFF
        return self._transaction

    def _write(self, values: Sequence[int], acknowledge: bool) -> bytes:
        """Encode one write of setpoints [mbar], in each slot behind its mode."""
        words = list(values)
        if self._motion_terminal:
            task = (ACKNOWLEDGE, FIRST_VALVE) if acknowledge else (REGULATE, BOTH_VALVES)
            for place in range(0, len(words) * 3 // 2, 3):
                words.insert(place, slot_word(*task))
        head = modbus.BLOCK.pack(FIRST_OUTPUT, len(words)) + bytes([2 * len(words)])
        return modbus.encode(self._next(), modbus.WRITE, head + modbus.to_bytes(words))

    # ----------------------------------------------------------------------- from the terminal

    def decode(self, data: bytes) -> list[Event]:
        """Return what complete answers say; any other frame is counted in ``rejected``."""
        before = self._frames.rejected
        events: list[Event] = []
        for _, frame in self._frames.feed(data):
            found = self._interpret(frame)
            self.rejected += not found
            events += found
        self.rejected += self._frames.rejected - before
        return events

    def _interpret(self, frame: modbus.ModbusFrame) -> list[Event]:
        if frame.function == modbus.WRITE and len(frame.data) == modbus.BLOCK.size:
            block = modbus.BLOCK.pack(FIRST_INPUT, INPUTS * self._places)
            self._follow_up = modbus.encode(self._next(), modbus.READ, block)
            return [Echo(frame.transaction)]
        if (
            frame.function in (modbus.READ | modbus.FAILED, modbus.WRITE | modbus.FAILED)
            and len(frame.data) == 1
        ):
            asked = "read" if frame.function == modbus.READ | modbus.FAILED else "write"
            said = f"refused: a {asked} of registers, exception {frame.data[0]}"
            return [BoardFailure(f"{said}; look at 'terminal' and 'segment_count'")]
        size = 2 * INPUTS * self._places
        if frame.function != modbus.READ or len(frame.data) != size + 1 or frame.data[0] != size:
            return []
        words = modbus.to_words(frame.data[1:])
        return self._slots(words) if self._motion_terminal else self._regulators(words)

    def _slots(self, words: Sequence[int]) -> list[Event]:
        """Read slots of a motion terminal, and go on with their start."""
        status = words[0::INPUTS]
        self._modes = {word & 0x3F for word in status}
        if self._modes == {INACTIVE} and self.clock() - self._started_at >= ACKNOWLEDGE_TIME:
            self._acknowledging = False
        problem = ""
        for slot, word in enumerate(status):
            mode, state = word & 0x3F, word >> 6 & 3
            if (mode, state) != (REGULATE, RUNNING):
                problem = problem or (
                    f"slot {slot} does not run: mode {mode}, state {state} ({STATES[state]}), "
                    f"application {word >> 8}"
                )
        pressures = [words[place] for place in range(len(words)) if place % INPUTS]
        return self._judge(problem, pressures)

    def _regulators(self, words: Sequence[int]) -> list[Event]:
        """Read regulators of an MPA terminal."""
        self._modes = {REGULATE}
        diagnoses = enumerate(words[2::INPUTS])
        found = [f"valve {valve} reports: diagnosis {code}" for valve, code in diagnoses if code]
        return self._judge("; ".join(found), words[0::INPUTS])

    def _judge(self, problem: str, pressures: Sequence[int]) -> list[Event]:
        """Return pressures; valves that cease to run are a failure, until then they start."""
        events: list[Event] = [BoardFailure(problem)] if problem and self._sound else []
        self._sound, self.unsettled = not problem, problem
        if self._sound:
            self._acknowledging = False
            self._started_at = -math.inf  # whatever fails next is started again at once
        gauge = (PASCAL_PER_MILLIBAR * modbus.signed(word) for word in pressures)
        readings = tuple(self.assumed_atmosphere + value for value in gauge)
        return [*events, Telemetry(chamber_pressure=readings)]
