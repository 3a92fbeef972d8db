"""The board beside its pressures: which it is, whether it answers, whether it starts anew."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from pressure_driver.protocols.base import BoardIdentity, Echo, HostProtocol
from pressure_driver.settings import Settings

IDENTITY_RETRY = 1.0
"""[s] after which a board that has not introduced or set itself up is greeted again."""
ECHO_TIMEOUT = 1.0
"""[s] without an echo of any command, on boards that echo: the board takes no commands."""


class BoardWatch:
    """Keeps what is known about the board.

    Args:
        protocol: the driver's end of the board's language.
        settings: what the board must reach, and what counts as vented.
    """

    def __init__(self, protocol: HostProtocol, settings: Settings) -> None:
        self.identity: BoardIdentity | None = None
        self.round_trip = float("nan")
        """[s] from the last command that was echoed to its echo."""
        self._protocol = protocol
        self._settings = settings
        self._awaiting_echo: deque[tuple[int | None, float]] = deque(maxlen=64)
        self._echo_awaited_since: float | None = None
        self._asked_at = 0.0
        self._problem = ""
        self._starting = False
        self._unknown = [-math.inf] * protocol.chamber_count
        self._at_start = self._unknown

    def opened(self, now: float) -> None:
        """The port has been opened: nothing is known about the board."""
        self._awaiting_echo.clear()
        self._echo_awaited_since = None
        self._starting = False
        self._forget_identity(now)

    def _forget_identity(self, now: float) -> None:
        self.identity = None
        self._asked_at = now
        if self._protocol.introduces_itself:
            self._problem = "the board has not introduced itself yet"

    # ----------------------------------------------------------------------------- its start

    def has_reset(self, last_reading: Sequence[float], now: float) -> None:
        """The board has started anew while the port was open.

        Args:
            last_reading: (2M,) [Pa] absolute, the newest before; NaN if there is none.
            now: [s] steady clock.
        """
        self._forget_identity(now)
        self.greet_now(now)
        self._starting = True
        self._at_start = [-math.inf if math.isnan(value) else value for value in last_reading]

    def greet_now(self, now: float) -> None:
        """Have what the board does not confirm asked at the next tick (steady clock [s])."""
        self._asked_at = now - IDENTITY_RETRY

    def says_words(self) -> None:
        """The board sends the words of its start."""
        if not self._starting:
            self._starting = True
            self._at_start = self._unknown

    def reports(self, reading: Sequence[float]) -> None:
        """The board reports chamber pressures (2M,) [Pa] absolute: its start is over."""
        if self._starting:
            self._starting = False
            self._at_start = list(map(max, self._at_start, reading))

    def started_under_pressure(self, rest: Sequence[float]) -> str:
        """Return the warning that the board may have taken trapped air for the room's, or nothing.

        Whether it has shows when it fills a chamber: see `LeakWatch`.

        Args:
            rest: (2M,) [Pa] absolute rest pressures; NaN while they are not known.
        """
        if not self._protocol.measures_room_at_start:
            return ""
        gauge = max(start - known for start, known in zip(self._at_start, rest, strict=True))
        # NaN while the rest is not known.
        if not gauge > self._settings.vented_tolerance:
            return ""
        return (
            f"the board started with {gauge:.0f} Pa in its chambers: if it takes that for the "
            "room's pressure, it will fill them too high; power it anew while they are vented"
        )

    # --------------------------------------------------------------------------- its answers

    def has_sent(self, number: int | None, now: float) -> None:
        """A command with this number, if its protocol has numbers, has gone out."""
        self._awaiting_echo.append((number, now))
        if self._echo_awaited_since is None:
            self._echo_awaited_since = now

    def take_echo(self, echo: Echo, now: float) -> None:
        """Measure the round trip; an echo without a number is that of the newest command."""
        if echo.sequence is None and self._awaiting_echo:
            self.round_trip = now - self._awaiting_echo[-1][1]
            self._awaiting_echo.clear()
            self._echo_awaited_since = None
        # A status that left the board before the newest command came echoes an older one: the
        # newest goes on waiting for its own.
        if echo.sequence not in [number for number, _ in self._awaiting_echo]:
            return
        while self._awaiting_echo:
            number, sent = self._awaiting_echo.popleft()
            if number == echo.sequence:
                self.round_trip = now - sent
                self._echo_awaited_since = now if self._awaiting_echo else None
                return

    def silence(self, now: float) -> str:
        """Return that the board does not answer, or nothing."""
        since = self._echo_awaited_since
        stalled = self._protocol.echoes and since is not None and now - since > ECHO_TIMEOUT
        return f"the board has not answered a command for {ECHO_TIMEOUT:g} s" if stalled else ""

    def greeting(self, now: float) -> bytes:
        """Return the greeting again while it has not been answered; a board may boot slowly."""
        unknown = self._protocol.introduces_itself and self.identity is None
        if not (self._protocol.unsettled or unknown):
            return b""
        if now - self._asked_at < IDENTITY_RETRY:
            return b""
        self._asked_at = now
        return self._protocol.start()

    def check_identity(self, identity: BoardIdentity) -> None:
        """Refuse to arm a board that is not the one which the parameters describe."""
        self.identity = identity
        expected = self._protocol.chamber_count
        problem = ""
        if identity.chamber_count != expected:
            problem = (
                f"the board has {identity.chamber_count} chambers, the driver expects "
                f"{expected}: set the parameter 'segment_count'"
            )
        elif identity.largest_pressure < (wanted := self._settings.pressure_limit):
            problem = (
                f"the board reaches {identity.largest_pressure:.0f} Pa, less than 'pressure_limit' "
                f"({wanted:.0f} Pa): lower the parameter"
            )
        self._problem = problem

    def obstacle(self, now: float) -> str:
        """Return what about the board forbids arming, or nothing (steady clock [s])."""
        problems = (self._problem, self._protocol.unsettled, self.silence(now))
        return next(filter(None, problems), "")
