"""The firmware of an emulated valve board with its faults: commands in, telemetry out."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pressure_driver.emulator import BoardCommand, BoardProtocol, BoardReading
from pressure_driver.emulator.pneumatics import SUPPLY_PRESSURE, BoardPneumatics

SENSOR_OFFSET = 200.0
"""[Pa] Sensors read up to this much too high, each its own."""
SENSOR_NOISE = 5.0
"""[Pa] Standard deviation of a reading."""


WORDS = {
    "drop": ("drop:SHARE (of the chunks that come from the host are lost)", 1, 1),
    "corrupt": ("corrupt:SHARE (of all bytes, both ways, get a bit flipped)", 1, 1),
    "delay": ("delay:SECONDS (telemetry is held back)", 1, 1),
    "mute": ("mute (no telemetry)", 0, 0),
    "deaf": ("deaf (every command is ignored)", 0, 0),
    "echoless": ("echoless (commands are executed and not repeated)", 0, 0),
    "hold": ("hold (a terminal that loses its bus keeps its outputs)", 0, 0),
    "reset": ("reset[:SECONDS] (the board loses power for SECONDS, 0.2 if not given)", 0, 1),
    "stick": ("stick:CHAMBER (its valves stop moving)", 1, 1),
    "leak": ("leak:CHAMBER[:RATE] (a hole drains it at RATE 1/s, 3 if not given)", 1, 2),
    "runaway": ("runaway:CHAMBER (its inlet valve stays open)", 1, 1),
    "supply": ("supply:PASCAL (absolute pressure of the reservoir)", 1, 1),
    "unplug": ("unplug[:SECONDS] (the port disappears, and comes back after SECONDS)", 0, 1),
}
"""Of every fault: its usage, the fewest and the most numbers behind its word."""
LEAK_RATE = 3.0
"""[1/s] of a hole for which no rate is given."""
DEFAULTS = {"reset": 0.2, "unplug": math.inf}
"""[s] for which these last if no time is given."""
USAGE = ", ".join(usage for usage, _, _ in WORDS.values())


class FaultError(ValueError):
    """A fault text that is not understood; the message lists the words."""


@dataclass
class Faults:
    """The faults in force."""

    drop: float = 0.0
    corrupt: float = 0.0
    delay: float = 0.0
    mute: bool = False
    deaf: bool = False
    echoless: bool = False
    hold: bool = False
    reset: float | None = None
    stick: list[int] = field(default_factory=list)
    leak: dict[int, float] = field(default_factory=dict)
    runaway: list[int] = field(default_factory=list)
    supply: float = SUPPLY_PRESSURE
    unplug: float | None = None

    @classmethod
    def parse(cls, texts: Iterable[str], chamber_count: int) -> Faults:
        """Return the faults named by texts such as ``stick:1``; empty texts are skipped.

        Raises:
            FaultError: a text is not understood.
        """
        faults = cls()
        for text in filter(None, map(str.strip, texts)):
            word, *arguments = text.split(":")
            _, fewest, most = WORDS.get(word, ("", 1, 0))
            numbers = []
            with contextlib.suppress(ValueError):
                numbers = [float(argument) for argument in arguments]
            sound = fewest <= len(arguments) == len(numbers) <= most
            if not sound or any(not number >= 0.0 for number in numbers):
                raise FaultError(f"fault '{text}' is not one of: {USAGE}")
            if word in ("stick", "leak", "runaway") and numbers[0] not in range(chamber_count):
                raise FaultError(f"fault '{text}': chambers are 0 … {chamber_count - 1}")
            if word in ("drop", "corrupt") and numbers[0] > 1.0:
                raise FaultError(f"fault '{text}': a share is 0 … 1")
            faults._set(word, numbers)
        return faults

    def _set(self, word: str, numbers: list[float]) -> None:
        chambers = getattr(self, word)
        if isinstance(chambers, list):
            chambers.append(int(numbers[0]))
        elif word == "leak":
            self.leak[int(numbers[0])] = (numbers[1:] or [LEAK_RATE])[0]
        else:
            setattr(self, word, (numbers or [DEFAULTS.get(word, True)])[0])

    def damage(self, data: bytes, generator: np.random.Generator) -> bytes:
        """Return ``data`` with bits flipped as `corrupt` says."""
        if self.corrupt <= 0.0 or not data:
            return data
        damaged = np.frombuffer(data, dtype=np.uint8).copy()
        hit = generator.random(len(damaged)) < self.corrupt
        bits = generator.integers(0, 8, len(damaged))
        damaged[hit] ^= (1 << bits[hit]).astype(np.uint8)
        return damaged.tobytes()


class EmulatedBoard:
    """Regulates the chambers of a `BoardPneumatics` as commanded over the wire.

    Args:
        protocol: the firmware's end of the language.
        pneumatics: the air.
        seed: of sensor errors and of random faults.
    """

    def __init__(self, protocol: BoardProtocol, pneumatics: BoardPneumatics, seed: int = 0) -> None:
        self.protocol = protocol
        self.pneumatics = pneumatics
        self.faults = Faults()
        self._generator = np.random.default_rng([seed, 0xB0A2D])
        count = pneumatics.chamber_count
        self._offset: NDArray[np.float64] = self._generator.uniform(0.0, SENSOR_OFFSET, count)
        self._unsaid = b""
        self._dead_for = 0.0
        self.boot()

    def boot(self) -> bytes:
        """Restart: vent, measure the room, greet."""
        self._vent()
        self._expired = False
        self._sequence = 0
        self._time = 0.0
        self.atmosphere = float(np.mean(self.pneumatics.pressure + self._offset))
        """[Pa] what the board takes for the room's pressure."""
        return self.protocol.boot(self.atmosphere)

    def restart(self, seconds: float) -> None:
        """Lose power for a moment: vented, deaf and mute for ``seconds``, then `boot`."""
        self._vent()
        self._unsaid = b""
        self._dead_for = seconds

    def set_faults(self, faults: Faults) -> None:
        """Have these faults from now on, and no others."""
        self.faults = faults
        air = self.pneumatics
        air.stuck[:] = False
        air.leak[:] = 0.0
        for chamber in faults.stick:
            air.stuck[chamber] = True
        for chamber, rate in faults.leak.items():
            air.leak[chamber] = rate
        air.supply_pressure = faults.supply
        self._apply()

    def receive(self, data: bytes) -> tuple[list[tuple[float, ...]], bytes]:
        """Take bytes from the host.

        Returns:
            Pressures (2M,) [Pa], absolute, of each command that became complete, and what the board
            answers.
        """
        if self._dead_for > 0.0:
            return [], b""
        if self.faults.drop > 0.0 and self._generator.random() < self.faults.drop:
            return [], b""
        data = self.faults.damage(data, self._generator)
        received: list[tuple[float, ...]] = []
        answer = b""
        for command in self.protocol.decode(data):
            if self.faults.deaf and command.kind != "read":
                continue
            answer += self._execute(command)
            if command.kind in ("setpoint", "vent"):
                received.append(self._wire_pressure(command))
        if self.faults.mute:
            answer = b""
        return received, self.faults.damage(answer, self._generator)

    def _wire_pressure(self, command: BoardCommand) -> tuple[float, ...]:
        if command.pressure is None:
            return (self.atmosphere,) * self.pneumatics.chamber_count
        if self.protocol.gauge:
            return tuple(self.atmosphere + value for value in command.pressure)
        return command.pressure

    def _execute(self, command: BoardCommand) -> bytes:
        if command.sequence is not None and not self.faults.echoless:
            self._sequence = command.sequence
        if command.kind == "vent":
            self._vent()
            self._expired = False
        elif command.kind == "setpoint" and command.pressure is not None:
            self._regulate(np.asarray(self.protocol.target(command.pressure, self._time)))
            self._expired = False
            if command.valid_for is not None:
                hold = self.faults.hold
                self._valid_until = math.inf if hold else self._time + command.valid_for
        if self.faults.echoless and command.kind != "read":
            return b""
        return self.protocol.reply(command, self.reading())

    def _vent(self) -> None:
        self._target = np.full(self.pneumatics.chamber_count, self.pneumatics.atmosphere)
        self._valid_until = math.inf
        self._vented = True
        self._apply()

    def _regulate(self, pressure: NDArray[np.float64]) -> None:
        """Translate wire pressures to true targets, as firmware with imperfect sensors does."""
        room = self.pneumatics.atmosphere
        if self.protocol.gauge:
            self._target = room + np.maximum(pressure, 0.0)
        else:
            low = np.minimum(pressure[0::2], pressure[1::2]).repeat(2)
            difference = pressure - low
            reading = self.atmosphere + difference
            self._target = np.where(difference > 0.0, reading - self._offset, room)
        self._vented = bool(np.all(self._target <= room))
        self._apply()

    def _apply(self) -> None:
        target = self._target.copy()
        for chamber in self.faults.runaway:
            target[chamber] = self.pneumatics.supply_pressure
        self.pneumatics.command(target)

    def step(self, duration: float) -> NDArray[np.float64]:
        """Let time pass and return the true chamber pressures (2M,) [Pa] absolute."""
        self._time += duration
        if self._dead_for > 0.0:
            self._dead_for -= duration
            if self._dead_for <= 0.0:
                self._unsaid = self.boot()
        if self._time > self._valid_until:
            self._vent()
            self._expired = True
            self._unsaid += self.protocol.expired()
        return self.pneumatics.step(duration)

    def reading(self) -> BoardReading:
        """Return what the sensors say now."""
        noise = self._generator.normal(0.0, SENSOR_NOISE, self.pneumatics.chamber_count)
        return BoardReading(
            time=self._time,
            chamber_pressure=tuple((self.pneumatics.pressure + self._offset + noise).tolist()),
            atmosphere=self.atmosphere,
            valve_opening=tuple(self.pneumatics.valve_opening.tolist()),
            supply_pressure=self.pneumatics.supply_pressure,
            last_sequence=self._sequence,
            vented=self._vented,
            expired=self._expired,
        )

    def telemetry(self) -> bytes:
        """Return the bytes of one report; nothing while muted."""
        if self._dead_for > 0.0:
            return b""
        report, self._unsaid = self._unsaid + self.protocol.telemetry(self.reading()), b""
        if self.faults.mute:
            return b""
        return self.faults.damage(report, self._generator)
