"""Faults that the emulated board can be told to have, by short texts such as ``stick:1``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

WORDS = {
    "drop": "drop:SHARE (of the chunks that come from the host are lost)",
    "corrupt": "corrupt:SHARE (of all bytes, both ways, get a bit flipped)",
    "delay": "delay:SECONDS (telemetry is held back)",
    "mute": "mute (no telemetry)",
    "deaf": "deaf (every command is ignored)",
    "echoless": "echoless (commands are executed and not repeated)",
    "reset": "reset[:SECONDS] (the board loses power for SECONDS, 0.2 if not given)",
    "stick": "stick:CHAMBER (its valves stop moving)",
    "leak": "leak:CHAMBER[:RATE] (a hole drains it at RATE 1/s, 3 if not given)",
    "runaway": "runaway:CHAMBER (its inlet valve stays open)",
    "supply": "supply:PASCAL (absolute pressure of the reservoir)",
    "unplug": "unplug[:SECONDS] (the port disappears, and comes back after SECONDS)",
}
"""Word and usage of every fault."""
USAGE = ", ".join(WORDS.values())


class FaultError(ValueError):
    """A fault text that is not understood; the message lists the words."""


@dataclass
class Faults:
    """The faults in force.

    Raises:
        FaultError: in `parse`, for a text that is not understood.
    """

    drop: float = 0.0
    corrupt: float = 0.0
    delay: float = 0.0
    mute: bool = False
    deaf: bool = False
    echoless: bool = False
    reset: float | None = None
    stuck: tuple[int, ...] = ()
    leaks: dict[int, float] = field(default_factory=dict)
    runaway: tuple[int, ...] = ()
    supply: float | None = None
    unplugged: bool = False
    replug_after: float | None = None

    @classmethod
    def parse(cls, texts: Iterable[str], chamber_count: int) -> Faults:
        """Return the faults named by texts such as ``stick:1``; empty texts are skipped."""
        faults = cls()
        for text in texts:
            if text.strip():
                faults._take(text.strip(), chamber_count)
        return faults

    def _take(self, text: str, chamber_count: int) -> None:
        word, *arguments = text.split(":")
        try:
            numbers = [float(argument) for argument in arguments]
        except ValueError:
            numbers = [float("nan")]
        wanted = dict.fromkeys(("mute", "deaf", "echoless"), (0, 0))
        wanted |= {"leak": (1, 2), "unplug": (0, 1), "reset": (0, 1)}
        low, high = wanted.get(word, (1, 1))
        well_formed = low <= len(numbers) <= high and all(number >= 0.0 for number in numbers)
        if word not in WORDS or not well_formed:
            raise FaultError(f"fault '{text}' is not one of: {USAGE}")
        if word in ("stick", "leak", "runaway") and not (
            numbers[0].is_integer() and numbers[0] < chamber_count
        ):
            raise FaultError(f"fault '{text}': chambers are 0 … {chamber_count - 1}")
        if word in ("drop", "corrupt") and numbers[0] > 1.0:
            raise FaultError(f"fault '{text}': a share is 0 … 1")
        self._set(word, numbers)

    def _set(self, word: str, numbers: list[float]) -> None:
        if word in ("drop", "corrupt", "delay", "supply"):
            setattr(self, word, numbers[0])
        elif word in ("mute", "deaf", "echoless"):
            setattr(self, word, True)
        elif word == "reset":
            self.reset = numbers[0] if numbers else 0.2
        elif word == "stick":
            self.stuck += (int(numbers[0]),)
        elif word == "runaway":
            self.runaway += (int(numbers[0]),)
        elif word == "leak":
            self.leaks[int(numbers[0])] = numbers[1] if len(numbers) > 1 else 3.0
        else:
            self.unplugged = True
            self.replug_after = numbers[0] if numbers else None

    def damage(self, data: bytes, generator: np.random.Generator) -> bytes:
        """Return ``data`` with bits flipped as `corrupt` says."""
        if self.corrupt <= 0.0 or not data:
            return data
        damaged = np.frombuffer(data, dtype=np.uint8).copy()
        hit = generator.random(len(damaged)) < self.corrupt
        bits = generator.integers(0, 8, len(damaged))
        damaged[hit] ^= (1 << bits[hit]).astype(np.uint8)
        return damaged.tobytes()
