"""How far the clock of a node's computer is off that of the driver's, and how sure that is.

A node asks, the driver answers, and four instants come together: sent, received, answered, back.
The offset is the mean of the two differences, and is wrong by at most half of the time that was
spent on the way (Mills et al., RFC 5905, sections 8 and 10).
"""

from __future__ import annotations

import math
import time
from collections import deque
from typing import NamedTuple

from rclpy.node import Node

from der_msgs.msg import ClockExchange
from limb_interfaces import qos, topics

MEMORY = 64
"""Exchanges that are kept."""
LARGEST_DRIFT = 100e-6
"""By which clocks of computers run apart at the most, as a share of the time that passes."""
WARNING = 1e-3
"""[s] of offset: more than a setpoint's stamp may be wrong by unnoticed."""
LARGEST = 10e-3
"""[s] of offset with which feedback is not used: a limb moves by a millimetre meanwhile."""
CLOCK_OFF = "the clock of this computer is"
"""How a node begins to say that its clock is off the driver's."""
_SECONDS = 1e-9


class Offset(NamedTuple):
    """What is to be added to the node's clock to have the driver's."""

    seconds: float
    """[s], NaN before the first answer."""
    uncertainty: float
    """[s] by which it may be wrong."""

    @property
    def warning(self) -> str:
        """What is wrong with the clock, and what to do; empty if nothing is."""
        if not abs(self.seconds) > max(WARNING, self.uncertainty):
            return ""
        side = "behind" if self.seconds > 0.0 else "ahead of"
        return (
            f"{CLOCK_OFF} {1e3 * abs(self.seconds):.1f} ms {side} the driver's "
            f"(± {1e3 * self.uncertainty:.1f} ms): have both computers run chrony "
            "(docs/guide/two_computers.md)"
        )

    @property
    def too_far(self) -> bool:
        """Whether it is surely more than feedback bears."""
        return abs(self.seconds) > max(LARGEST, self.uncertainty)


class OffsetEstimate:
    """The best of the exchanges that are remembered: short on their way, and young."""

    def __init__(self) -> None:
        self._exchanges: deque[tuple[float, float, float]] = deque(maxlen=MEMORY)

    def add(self, sent: int, received: int, answered: int, back: int) -> None:
        """Take one exchange [ns]: the first and the last by the clock of the node that asks.

        An answer that is back before it was sent tells nothing. One that contradicts the others
        says that a clock was set: they are forgotten.
        """
        delay = _SECONDS * ((back - sent) - (answered - received))
        offset = _SECONDS * ((received - sent) + (answered - back)) / 2.0
        if delay < 0.0 or back < sent:
            return
        best = self.at(back)
        if abs(offset - best.seconds) > best.uncertainty + delay / 2.0:
            self._exchanges.clear()  # both cannot be true: a clock was set
        self._exchanges.append((_SECONDS * back, offset, delay))

    def at(self, now: int) -> Offset:
        """Return the offset at this time of the node's clock [ns]."""
        best = Offset(math.nan, math.inf)
        for back, offset, delay in self._exchanges:
            age = abs(_SECONDS * now - back)
            uncertainty = delay / 2.0 + LARGEST_DRIFT * age
            if uncertainty < best.uncertainty:
                best = Offset(offset, uncertainty)
        return best


class ClockWatch:
    """Asks the driver for its time; in the driver, answers.

    Args:
        node: whose clock is looked at.
        answers: this is the node whose clock counts.
    """

    def __init__(self, node: Node, answers: bool) -> None:
        self._name = node.get_fully_qualified_name()
        self._estimate = OffsetEstimate()
        says, hears, hear = topics.CLOCK_QUESTIONS, topics.CLOCK_ANSWERS, self._take
        if answers:
            says, hears, hear = topics.CLOCK_ANSWERS, topics.CLOCK_QUESTIONS, self._answer
        self._publisher = node.create_publisher(ClockExchange, says, qos.CLOCKS)
        node.create_subscription(ClockExchange, hears, hear, qos.CLOCKS)
        self._answers = answers

    def _answer(self, message: ClockExchange) -> None:
        message.received = time.time_ns()
        message.answered = time.time_ns()
        self._publisher.publish(message)

    def _take(self, message: ClockExchange) -> None:
        if message.node == self._name:
            self._estimate.add(message.sent, message.received, message.answered, time.time_ns())

    def look(self) -> Offset | None:
        """Ask again, and return what is known; None in the driver, and before the first answer."""
        if self._answers:
            return None
        now = time.time_ns()
        self._publisher.publish(ClockExchange(node=self._name, sent=now))
        offset = self._estimate.at(now)
        return offset if math.isfinite(offset.seconds) else None
