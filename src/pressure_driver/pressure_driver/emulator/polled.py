"""Boards that speak when they are spoken to: a Festo terminal and a PneuDrive board."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pressure_driver.emulator import BoardCommand, BoardProtocol, BoardReading
from pressure_driver.following import Duration
from pressure_driver.protocols import festo
from pressure_driver.protocols.pneudrive import PneudriveEnd
from pressure_driver.settings import EmulatorSettings

BUS_PATIENCE = 1.0
"""[s] without a write, after which a terminal takes the bus for lost and resets its outputs."""
SLOT_START_TIME = 1.5
"""[s] from the mode to a slot that runs."""
PNEUDRIVE_BOOT_TIME = 2.0
"""[s] for which a PneuDrive board vents at its start, whatever it is told."""
NOT_READY, TO_BE_CONFIGURED = 0, 1
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS = 1, 2
"""Exceptions of Modbus."""


class Slot:
    """Two valves of a motion terminal: they regulate once they have been started."""

    def __init__(self) -> None:
        self.mode = 0
        self.state = TO_BE_CONFIGURED
        self._starting = Duration()

    def tell(self, word: int) -> None:
        """Take over the first register of the slot."""
        mode, control = word & 0x3F, word >> 6 & 3
        if mode in (festo.ACKNOWLEDGE, festo.INACTIVE):
            self.mode, self.state = festo.INACTIVE, TO_BE_CONFIGURED
        elif (mode, control, self.mode) == (festo.REGULATE, festo.BOTH_VALVES, festo.INACTIVE):
            self.mode, self.state = festo.REGULATE, NOT_READY

    def look(self, time: float) -> None:
        """Go on with the start (time since boot [s])."""
        self._starting.note(self.state == NOT_READY, time)
        if self._starting.until(time) >= SLOT_START_TIME:
            self.state = festo.RUNNING


class FestoBoard(BoardProtocol):
    """The terminal's end of ``festo``."""

    gauge = True
    _motion_terminal = True

    def configure(self, settings: EmulatorSettings) -> None:
        """Take over which valves the terminal has."""
        self._motion_terminal = settings.terminal == "vtem"
        self.boot(0.0)

    def boot(self, atmosphere: float) -> bytes:  # noqa: ARG002 - the wire has gauge pressures
        """All registers are zero, and slots have to be started."""
        self.slots = [Slot() for _ in range(self.chamber_count // 2 * self._motion_terminal)]
        self._outputs = [0] * (3 * len(self.slots) or self.chamber_count)
        return b""

    def _cut(self) -> Iterator[festo.ModbusFrame | None]:
        return festo.cut_frames(self._kept)

    def _interpret(self, frame: festo.ModbusFrame) -> list[BoardCommand]:
        """Return a read or a write; what is not there comes back as ``refused``."""
        function, data, number = frame.function, frame.data, frame.transaction
        first, count = festo.BLOCK.unpack(data[:4].ljust(4, b"\0"))
        if function == festo.READ:
            return [BoardCommand("read", sequence=number, text=f"{first} {count}")]
        words, offset = festo.to_words(data[5:]), first - festo.FIRST_OUTPUT
        inside = 0 <= offset <= len(self._outputs) - count
        if function == festo.WRITE and inside and len(words) == count:
            self._outputs[offset : offset + count] = words
            for slot, word in zip(self.slots, self._outputs[0::3], strict=False):
                slot.tell(word)
            told = self._setpoints()
            return [BoardCommand("setpoint", told, BUS_PATIENCE, number, f"{first} {count}")]
        self.rejected += 1
        problem = ILLEGAL_ADDRESS if function == festo.WRITE else ILLEGAL_FUNCTION
        return [BoardCommand("refused", sequence=number, text=f"{function} {problem}")]

    def _setpoints(self) -> tuple[float, ...]:
        values = [v for place, v in enumerate(self._outputs) if place % 3 or not self.slots]
        return tuple(festo.PASCAL_PER_MILLIBAR * value for value in values)

    def target(self, pressure: Sequence[float], time: float) -> Sequence[float]:
        """Return setpoints of slots that run; the others are vented."""
        if not self.slots:
            return pressure
        for slot in self.slots:
            slot.look(time)
        return [
            value if self.slots[chamber // 2].state == festo.RUNNING else 0.0
            for chamber, value in enumerate(pressure)
        ]

    def _inputs(self, reading: BoardReading) -> list[int]:
        gauge = (pressure - reading.atmosphere for pressure in reading.chamber_pressure)
        measured = [round(value / festo.PASCAL_PER_MILLIBAR) for value in gauge]
        if not self.slots:
            pairs = zip(measured, self._outputs, strict=True)
            return [word for value, told in pairs for word in (value, told, 0)]
        words: list[int] = []
        for place, slot in enumerate(self.slots):
            slot.look(reading.time)
            words += [festo.slot_word(slot.mode, slot.state), *measured[2 * place : 2 * place + 2]]
        return words

    def reply(self, command: BoardCommand, reading: BoardReading) -> bytes:
        """Registers to a read, first register and their number to a write, else an exception."""
        number, (first, second) = command.sequence or 0, map(int, command.text.split())
        if command.kind == "refused":
            return festo.encode(number, first | festo.FAILED, bytes([second]))
        if command.kind == "setpoint":
            return festo.encode(number, festo.WRITE, festo.BLOCK.pack(first, second))
        words, offset = self._inputs(reading), first - festo.FIRST_INPUT
        if not 0 <= offset <= len(words) - second:
            return festo.encode(number, festo.READ | festo.FAILED, bytes([ILLEGAL_ADDRESS]))
        data = festo.to_bytes(words[offset : offset + second])
        return festo.encode(number, festo.READ, bytes([len(data)]) + data)

    def expired(self) -> bytes:
        """The bus is lost: all outputs are zero, and slots have to be started again."""
        return self.boot(0.0)


class PneudriveBoard(PneudriveEnd, BoardProtocol):
    """The board's end of ``pneudrive``."""

    gauge = True

    def _interpret(self, gauge: tuple[float, ...]) -> list[BoardCommand]:
        """Return targets."""
        return [BoardCommand("setpoint", gauge)]

    def target(self, pressure: Sequence[float], time: float) -> Sequence[float]:
        """Return the targets; nothing while the board starts."""
        return pressure if time >= PNEUDRIVE_BOOT_TIME else [0.0] * len(pressure)

    def reply(self, command: BoardCommand, reading: BoardReading) -> bytes:  # noqa: ARG002
        """What the board measures, in the layout of its targets."""
        return self.encode([p - reading.atmosphere for p in reading.chamber_pressure])
