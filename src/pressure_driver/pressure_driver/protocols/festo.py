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

A frame of Modbus TCP is ``transaction u16, 0 u16, length u16, unit u8, function u8, data``, all
big-endian; the length counts what follows it. (Modbus Messaging on TCP/IP Implementation Guide
V1.0b.) Register numbers are those on the wire, which count from 0.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

from pressure_driver.protocols import (
    BoardFailure,
    Echo,
    Event,
    HostProtocol,
    Telemetry,
    skip_to,
)

if TYPE_CHECKING:
    from pressure_driver.settings import Settings

HEADER = struct.Struct(">HHHBB")
BLOCK = struct.Struct(">HH")
UNIT = 0xFF
"""What is spoken to is the server itself, and no device behind it."""
READ = 3
WRITE = 16
FAILED = 0x80
"""Added to the function in the answer to a request that is refused."""
LONGEST_LENGTH = 254
"""[bytes] of unit, function and data."""
LENGTH_BEGINS = 6
"""[bytes] before those that the length counts."""
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


class ModbusFrame(NamedTuple):
    """One request or answer."""

    transaction: int
    function: int
    data: bytes


def encode(transaction: int, function: int, data: bytes) -> bytes:
    """Return the bytes of a frame."""
    return HEADER.pack(transaction & 0xFFFF, 0, len(data) + 2, UNIT, function) + data


def to_bytes(words: Iterable[int]) -> bytes:
    """Return registers as they are sent; negative numbers as their two's complement."""
    return b"".join((word & 0xFFFF).to_bytes(2, "big") for word in words)


def to_words(data: bytes) -> tuple[int, ...]:
    """Return registers as numbers with sign; half a register at the end is left out."""
    return struct.unpack_from(f">{len(data) // 2}h", data)


def cut_frames(kept: bytearray) -> Iterator[ModbusFrame | None]:
    """Take complete frames.

    TCP loses and changes nothing. What does not begin as a frame is skipped to where one may begin.
    """
    while len(kept) >= HEADER.size:
        transaction, zero, length, _, function = HEADER.unpack_from(kept)
        if zero or not 2 < length <= LONGEST_LENGTH:
            # The two zero bytes stand behind the transaction.
            skip_to(kept.find(b"\0\0", 3) - 2, kept)
            yield None
            continue
        end = LENGTH_BEGINS + length
        if len(kept) < end:
            break
        data = bytes(kept[HEADER.size : end])
        del kept[:end]
        yield ModbusFrame(transaction, function, data)


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
    reach = LARGEST_SETPOINT * PASCAL_PER_MILLIBAR

    _motion_terminal = True

    def configure(self, settings: Settings) -> None:
        """Take over which valves the terminal has."""
        self._motion_terminal = settings.terminal == "vtem"

    def reset(self) -> None:
        """Forget a half-received frame and whether the valves run."""
        super().reset()
        self._follow_up = b""
        self._sound: bool | None = None
        """Whether all valves ran at the last report; None before the first."""
        self._acknowledging = False
        self._started_at = -math.inf
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
        if self._sound is False and now - self._started_at > START_TIME:
            self._started_at = now
            self._acknowledging = self._motion_terminal
        return b""

    def setpoint(self, gauge: Sequence[float]) -> bytes:
        """Encode one write of all setpoints to 1 mbar; its answer brings the question."""
        millibar = (round(value / PASCAL_PER_MILLIBAR) for value in gauge)
        values = [min(max(value, 0), LARGEST_SETPOINT) for value in millibar]
        return self._write(values, self._acknowledging)

    def emergency(self) -> bytes:
        """Regulate to the room's pressure, also where slots are being acknowledged."""
        return self._write([0] * self.chamber_count, False)

    @property
    def _places(self) -> int:
        """Slots, or valves of an MPA terminal."""
        return self.chamber_count // 2 if self._motion_terminal else self.chamber_count

    def _write(self, values: Sequence[int], acknowledge: bool) -> bytes:
        """Encode one write of setpoints [mbar], in each slot behind its mode."""
        words = list(values)
        if self._motion_terminal:
            task = (ACKNOWLEDGE, FIRST_VALVE) if acknowledge else (REGULATE, BOTH_VALVES)
            for place in range(0, len(words) * 3 // 2, 3):
                words.insert(place, slot_word(*task))
        head = BLOCK.pack(FIRST_OUTPUT, len(words)) + bytes([2 * len(words)])
        return encode(self._next(), WRITE, head + to_bytes(words))

    # ----------------------------------------------------------------------- from the terminal

    def _cut(self) -> Iterator[ModbusFrame | None]:
        return cut_frames(self._kept)

    def _interpret(self, frame: ModbusFrame) -> list[Event]:
        if frame.function == WRITE and len(frame.data) == BLOCK.size:
            block = BLOCK.pack(FIRST_INPUT, INPUTS * self._places)
            self._follow_up = encode(self._next(), READ, block)
            return [Echo(frame.transaction)]
        if frame.function in (READ | FAILED, WRITE | FAILED) and len(frame.data) == 1:
            asked = "read" if frame.function == READ | FAILED else "write"
            said = f"refused: a {asked} of registers, exception {frame.data[0]}"
            return [BoardFailure(f"{said}; look at 'terminal' and 'segment_count'")]
        size = 2 * INPUTS * self._places
        if frame.function != READ or len(frame.data) != size + 1 or frame.data[0] != size:
            return []
        words = to_words(frame.data[1:])
        return self._slots(words) if self._motion_terminal else self._regulators(words)

    def _slots(self, words: Sequence[int]) -> list[Event]:
        """Read slots of a motion terminal, and go on with their start."""
        status = words[0::INPUTS]
        modes = {word & 0x3F for word in status}
        if modes == {INACTIVE} and self.clock() - self._started_at >= ACKNOWLEDGE_TIME:
            self._acknowledging = False
        problem = ""
        for slot, word in enumerate(status):
            mode, state = word & 0x3F, word >> 6 & 3
            if (mode, state) != (REGULATE, RUNNING):
                problem = problem or (
                    f"slot {slot} does not run: mode {mode}, state {state} ({STATES[state]}), "
                    f"application {word >> 8 & 0xFF}"
                )
        pressures = [words[place] for place in range(len(words)) if place % INPUTS]
        return self._judge(problem, pressures)

    def _regulators(self, words: Sequence[int]) -> list[Event]:
        """Read regulators of an MPA terminal."""
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
        gauge = (PASCAL_PER_MILLIBAR * millibar for millibar in pressures)
        readings = tuple(self.assumed_atmosphere + value for value in gauge)
        return [*events, Telemetry(chamber_pressure=readings)]
