r"""The lab's four-chamber board: ASCII lines at 115200 baud, absolute pressures in hPa.

To the board, up to 20 times a second::

    <1013.25,1088.25,1013.25,1013.25>\n

The board takes each pair as a difference: it vents the smaller of the two and holds its own
atmosphere plus the difference in the other. A command with a value above 1250 hPa is ignored
whole. From the board at 20 Hz::

    [MPR]: 1013.31 1013.02 1014.55 1013.90     chambers, hPa absolute
    [RPR]: 1401.22                             reservoir, hPa absolute
    [VAL]: 0.00 0.31 0.00 0.12                 inlet valves, 0 … 1

and free text while it boots (some seconds after the port has opened, since opening resets it).
There is no checksum, no echo and no watchdog: it holds the last pressures for ever.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from pressure_driver.protocols import BoardReset, BoardText, Event, LineHost, Telemetry

PASCAL_PER_HECTOPASCAL = 100.0
LARGEST_WIRE_VALUE = 1250.0
"""[hPa] The board ignores a command that has more."""

_WORD = re.compile(r"[A-Za-z]{3}")
_NUMBER = re.compile(r"-?\d{1,6}(?:\.\d{1,6})?|-?nan|-?inf", re.IGNORECASE)
"""A plain decimal, or what firmware prints for a sensor that is broken: the driver judges that."""


def numbers_of(text: str, separator: str | None) -> list[float] | None:
    """Return the numbers of a list, or None if one of them is not a plain decimal."""
    parts = text.split(separator)
    if not all(_NUMBER.fullmatch(part) for part in parts):
        return None
    return [float(part) for part in parts]


class EzloopHost(LineHost):
    """The driver's end of ``ezloop``."""

    name = "ezloop"
    weaknesses = (
        "no watchdog: if this computer dies, the board keeps the last pressures",
        "no checksum: a damaged number can pass for a pressure",
    )
    reports_supply = True
    tells_pascals = True
    reach = LARGEST_WIRE_VALUE * PASCAL_PER_HECTOPASCAL

    def start(self) -> bytes:
        """A line end, which finishes whatever an earlier program left half-sent."""
        return b"\n"

    def setpoint(self, gauge: Sequence[float]) -> bytes:
        """Encode differences as pairs of absolute pressures, to 1 Pa.

        A pair that would pass 1250 hPa is sent lower as a pair: the board only reads differences.
        """
        values, room = list[float](), self.room() / PASCAL_PER_HECTOPASCAL
        for pair in zip(gauge[0::2], gauge[1::2], strict=True):
            sizes = [value / PASCAL_PER_HECTOPASCAL for value in pair]
            low = min(room, LARGEST_WIRE_VALUE - max(sizes))
            low = math.floor(low * 100.0) / 100.0
            values += [low + round(size, 2) for size in sizes]
        return ("<" + ",".join(f"{value:.2f}" for value in values) + ">\n").encode()

    def _parse(self, line: str) -> Event | None:
        tag, separator, rest = line.partition(":")
        if not separator or tag not in ("[MPR]", "[RPR]", "[VAL]"):
            # A line with a bracket, or of digits only, is the rest of a damaged report.
            damaged = "[" in line or "]" in line or not any(c.isalpha() for c in line)
            return None if damaged else self._parse_words(line)
        values = numbers_of(rest.strip(), None)
        expected = 1 if tag == "[RPR]" else self.chamber_count
        if values is None or len(values) != expected:
            return None
        if tag == "[VAL]":
            if not all(0.0 <= value <= 1.0 for value in values):
                return None
            return Telemetry(valve_opening=tuple(values))
        self._reporting = True
        pascals = tuple(value * PASCAL_PER_HECTOPASCAL for value in values)
        if tag == "[RPR]":
            return Telemetry(supply_pressure=pascals[0])
        return Telemetry(chamber_pressure=pascals)

    def _parse_words(self, line: str) -> Event:
        """Words after reports: the board only talks while it boots, so it has started again."""
        if self._reporting and _WORD.search(line):
            self._reporting = False
            return BoardReset("it sends words, as it does while it boots")
        return BoardText(line)

    def reset(self) -> None:
        """Forget a half-received line, and that the board was running."""
        super().reset()
        self._reporting = False
