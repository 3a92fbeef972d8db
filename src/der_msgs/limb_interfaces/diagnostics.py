"""One diagnostics publisher for every node: `/diagnostics`, once a second, more often at first."""

from __future__ import annotations

import hashlib
import math
import os
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.duration import Duration
from rclpy.node import Node

from der_msgs import msg
from limb_interfaces import qos, topics
from limb_interfaces.clocks import ClockWatch

ENDED_IN_ORDER = "ended in order"
"""What a node says last, unless something ended it: its silence is then no alarm."""
TOUCHED = "something touched the limb"
"""How the planner begins to say why a plan has ended, where it had the limb vented for that."""
PRESSED = 1.0 / 24.0
"""A limb counts as under pressure from this share of the driver's limit on."""
SENSOR_OFFSET = 1_000.0
"""[Pa] that a sensor of a vented chamber may read above the others."""


@dataclass
class Health:
    """What a node says of itself: a level, a sentence and numbers by name."""

    level: str = "ok"
    message: str = "running"
    values: Mapping[str, object] = field(default_factory=dict)


_LEVELS = {
    "ok": DiagnosticStatus.OK,
    "warning": DiagnosticStatus.WARN,
    "error": DiagnosticStatus.ERROR,
    "stale": DiagnosticStatus.STALE,
}
_INTERVAL = 1.0
"""Time between two messages [s]."""
_FIRST_INTERVAL = 0.2
"""Time between two messages of a node that starts [s]."""
_FIRST_READY = 2.0
"""Time for which a node that is ready goes on to speak more often [s]."""
_FIRST_TIME = 20.0
"""Longest time for which a node that starts speaks more often [s]."""
_LAST_WORDS = Duration(seconds=0.2)
"""Listeners have this long to receive what a node says last."""
_CPU_INTERVAL = 0.5
"""Shortest time over which the CPU time is measured [s]: over less, its own ticks show."""


def highest_gauge(state: msg.PressureState) -> float:
    """Return the highest gauge pressure in a chamber [Pa], also where both of a pair are full.

    It is 0 where it may be a sensor's offset, and NaN where it is not known.
    """
    measured, commanded = state.measured_chamber, state.commanded_chamber
    highest = max(measured, default=math.nan) - min(commanded, default=math.nan)
    return 0.0 if highest < SENSOR_OFFSET else highest


def is_vented(state: msg.PressureState, limit: float) -> bool:
    """Tell whether all pressures are known and small beside the driver's limit [Pa]."""
    told = (*state.measured_differential, highest_gauge(state))
    return all(abs(value) < PRESSED * limit for value in told)


@cache
def message_version() -> str:
    """Return a short digest of all messages of the project: nodes with another do not hear this."""
    kinds = [kind for name, kind in sorted(vars(msg).items()) if name[0].isupper()]
    fields = [(kind.__name__, sorted(kind.get_fields_and_field_types().items())) for kind in kinds]
    return hashlib.sha256(repr(fields).encode()).hexdigest()[:8]


class DiagnosticsPublisher:
    """Calls ``report`` once a second and publishes what it returns, the CPU time and the process.

    A node that starts speaks more often until it is ready and others had the time to find it, so
    that nobody who waits for it waits for its next second. Meanwhile it listens, too: a node of its
    name that another process began earlier ends it, with a sentence that names both and the remedy.

    Args:
        node: the node that the status is about.
        report: returns the present health; its ``level`` is ok, warning, error or stale.
        hardware_id: what the node is connected to, if anything.
        clock_of_all: the clocks of all others are compared with this node's.
    """

    def __init__(
        self,
        node: Node,
        report: Callable[[], Health],
        hardware_id: str = "",
        clock_of_all: bool = False,
    ) -> None:
        self._node = node
        self._report = report
        self._hardware_id = hardware_id
        self._clock = ClockWatch(node, clock_of_all)
        self._publisher = node.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, qos.STATES)
        self._process, self._started = f"{socket.gethostname()}:{os.getpid()}", time.time()
        self._others = node.create_subscription(
            DiagnosticArray, topics.DIAGNOSTICS, self._look_for_namesake, qos.STATES
        )
        self._used, self._looked = time.process_time(), time.monotonic()
        self._cpu = 0.0
        self._slow_from = time.monotonic() + _FIRST_TIME
        self._timer = node.create_timer(_FIRST_INTERVAL, self._publish_first)
        node.conclude = self.conclude  # for `limb_interfaces.runner`

    def _publish_first(self) -> None:
        now = time.monotonic()
        if self.publish() in ("ok", "warning"):
            self._slow_from = min(self._slow_from, now + _FIRST_READY)
        if now >= self._slow_from:
            self._node.destroy_timer(self._timer)
            self._node.destroy_subscription(self._others)
            self._timer = self._node.create_timer(_INTERVAL, self.publish)

    def _look_for_namesake(self, message: DiagnosticArray) -> None:
        """End this node where an older one of its name is alive; one that was killed is silent."""
        own = self._node.get_fully_qualified_name()
        for status in (each for each in message.status if each.name == own):
            said = {pair.key: pair.value for pair in status.values}
            process, started = said.get("process", ""), float(said.get("started", "inf"))
            if process != self._process and started < self._started:
                self._node.fatal_error = (
                    f"a node {own} is running already (process {process}): end it first, give this "
                    "one another name or namespace (--ros-args -r __ns:=/OTHER), or set another "
                    "ROS_DOMAIN_ID"
                )

    def conclude(self) -> None:
        """Say that the node ends in order, and wait shortly until it has been heard."""
        self._report = lambda: Health("stale", ENDED_IN_ORDER)
        self.publish()
        self._publisher.wait_for_all_acked(_LAST_WORDS)

    def publish(self) -> str:
        """Publish now, without waiting for the next second; return the level."""
        health = self._report()
        level, text, values = health.level, health.message, dict(health.values)
        if offset := self._clock.look():
            values["clock_offset_s"] = f"{offset.seconds:.6f}"
            values["clock_uncertainty_s"] = f"{offset.uncertainty:.6f}"
            if offset.warning and level == "ok":
                level, text = "warning", f"{text}; {offset.warning}"
        values |= {
            "cpu_percent": f"{self._measure_cpu():.0f}",
            "process": self._process,
            "started": f"{self._started:.3f}",
            "messages": message_version(),
        }
        status = DiagnosticStatus(
            level=_LEVELS[level],
            name=self._node.get_fully_qualified_name(),
            message=text,
            hardware_id=self._hardware_id,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
        return level

    def _measure_cpu(self) -> float:
        """Return this process's share of one core [%] since it was last measured."""
        used, now = time.process_time(), time.monotonic()
        if now - self._looked >= _CPU_INTERVAL:
            self._cpu = 100.0 * (used - self._used) / (now - self._looked)
            self._used, self._looked = used, now
        return self._cpu
