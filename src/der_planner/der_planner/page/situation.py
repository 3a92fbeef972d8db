"""What the page knows of the graph, in the units that it shows, and how old each part is."""

from __future__ import annotations

import math
import shlex
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import Log

from der_msgs.msg import LimbContact, LimbEstimate, LimbState, PressurePlan, PressureState
from der_planner.limb import mounting_of
from der_planner.page.alarm import LATE, NODES, alarms, describe_limb, missing, worst_first
from limb_interfaces.diagnostics import ENDED_IN_ORDER, highest_gauge
from limb_interfaces.stamps import NANOSECONDS, nanoseconds
from pressure_driver.protocols import USUAL_LIMIT

PASCAL_PER_KILOPASCAL = 1000.0
CENTIMETRES = 100.0
GRAMS = 1000.0
PERCENT = 100.0
FRESH = {"driver": 0.5, "tracker": 0.5, "camera": 0.7, "estimate": 0.5, "contact": 0.5}
"""The newest message of a source may be this old [s] before the page greys it."""
DEAD = 5.0
"""A node counts as dead after this time [s] without diagnostics."""
ENDED, STOPPED = "its process has ended", "its process is stopped"
MODES = {
    "disarmed": "vented: it does not move",
    "armed": "may move",
    "tracking": "moves",
    "holding": "keeps its pressures",
    "venting": "lets its pressures down",
    "fault": "told to vent: something failed",
}
"""The driver's modes, in the order of their numbers, and what each means for the limb."""
SILENT = "silent"
"""In place of the mode of a driver that is not heard any more."""
FORGOTTEN = 60.0
"""A node that is none of this limb's is forgotten after this time [s] without diagnostics."""
FATAL = 50
"""Level of a node's last words in the log."""
LEVELS = ("ok", "warning", "error", "stale")
REFERENCES_KEPT = 200
_UNKNOWN: tuple[str, psutil.Process | None, str] = ("", None, "")
GAP = NANOSECONDS // 5
"""References that are further apart than this [ns] are not of one motion."""


class Situation:
    """The newest of everything, with the instant it came at; safe to use from several threads.

    Messages are read when they come, so that one that makes no sense is refused then.

    Args:
        clock: steady [s].
        namespace: of this limb's nodes.
    """

    def __init__(
        self, clock: Callable[[], float] = time.monotonic, namespace: str = "/limb"
    ) -> None:
        self.namespace = namespace
        self._own = {f"{namespace}/{name}": name for name in NODES}
        self._clock = clock
        self._last_words: dict[str, str] = {}
        self._lock = threading.Lock()
        self._heard: dict[str, float] = {}
        self._values: dict[str, dict[str, Any]] = {}
        self._plan = ""
        self._tip: tuple[int, tuple[float, float]] | None = None
        self._nodes: dict[str, tuple[dict[str, Any], float]] = {}
        self._processes: dict[str, tuple[str, psutil.Process | None, str]] = {}
        self._references: deque[tuple[int, float, float]] = deque(maxlen=REFERENCES_KEPT)

    # What comes in -------------------------------------------------------------------------

    def hear(self, source: str, values: dict[str, Any] | None = None) -> None:
        """Note that a source has sent something now, and what it said."""
        with self._lock:
            self._heard[source] = self._clock()
            if values is not None:
                self._values[source] = values

    def put_driver(self, message: PressureState) -> None:
        """Take the driver's state."""
        known = dict(enumerate(MODES.items()))
        mode, meaning = known.get(message.mode, (f"unknown mode {message.mode}", "unknown"))
        measured, highest = message.measured_differential, highest_gauge(message)
        if not message.telemetry_age <= FRESH["driver"]:  # the board's last ones, maybe of long ago
            measured, highest = [math.nan] * len(measured), math.nan
        values = {
            "mode": mode,
            "meaning": meaning,
            "faults": list(message.faults),
            "plan_id": message.plan_id,
            "commanded_kpa": _kilopascal(message.commanded_differential),
            "measured_kpa": _kilopascal(measured),
            "highest_kpa": _number(highest / PASCAL_PER_KILOPASCAL, 3),
            "limit_kpa": self.limit / PASCAL_PER_KILOPASCAL,
            "supply_kpa": _number(message.supply_pressure / PASCAL_PER_KILOPASCAL, 1),
            "telemetry_age": _number(message.telemetry_age, 2),
        }
        self.hear("driver", values)

    def put_limb(self, message: LimbState) -> None:
        """Take what the tracker says of one image."""
        values = {
            "valid": message.valid,
            "reason": message.reason,
            "tip_cm": [_number(value * CENTIMETRES, 2) for value in (message.tip.x, message.tip.y)],
            "bend_deg": [_number(math.degrees(value), 2) for value in message.bend_angle],
        }
        self.hear("tracker", values)
        tip = nanoseconds(message.header.stamp), (message.tip.x, message.tip.y)
        self._tip = tip if message.valid else None

    def put_estimate(self, message: LimbEstimate) -> None:
        """Take what feedback knows beside the shape."""
        values = {
            "missing_kpa": _kilopascal(message.missing_pressure),
            "missing_sigma_kpa": _kilopascal(message.missing_pressure_sigma),
            "gain_error_percent": [_number(error * PERCENT, 1) for error in message.gain_error],
            "correction_kpa": _kilopascal(message.correction),
            "share_percent": _number(message.share * PERCENT, 0),
            "reason": message.reason,
        }
        self.hear("estimate", values)

    def put_contact(self, message: LimbContact) -> None:
        """Take what touches the limb."""
        self.hear("contact", {"touched": message.touched, "said": message.said})

    def put_plan(self, message: PressurePlan) -> None:
        """Take the newest plan; it is shown as a line for people."""
        carried = ""
        if message.payload:
            place = f"{message.payload_at * CENTIMETRES:.1f} cm from the clamp"
            carried = f", carrying {message.payload * GRAMS:.3g} g at "
            carried += place if message.payload_at else "the tip"
        self._plan = (
            f"{message.motion}, {message.model} {message.method}, for the limb '{message.limb}', "
            f"{mounting_of(message.gravity)}{carried}; "
            f"predicted error {centimetres(message.predicted_error)}"
        )

    def put_reference(self, stamp: int, x: float, y: float) -> None:
        """Take where the tip should be [m] at an instant [ns], which may lie ahead."""
        with self._lock:
            newest = self._references[-1][0] if self._references else stamp
            if not 0 < stamp - newest <= GAP:
                self._references.clear()  # a newer plan took over, or begins after a pause
            self._references.append((stamp, x, y))

    def put_status(self, status: DiagnosticStatus) -> None:
        """Take a node's diagnostics."""
        level = int.from_bytes(status.level, "little")
        values = {entry.key: entry.value for entry in status.values}
        node = {
            "name": status.name,
            "own": self._own.get(status.name, ""),
            "state": LEVELS[level] if level < len(LEVELS) else "error",
            "message": status.message,
            "values": values,
        }
        process = values.get("process", "")
        with self._lock:
            self._forget_nodes()
            self._nodes[status.name] = node, self._clock()
            if process != self._processes.get(status.name, _UNKNOWN)[0]:
                self._processes[status.name] = (process, *_process(process))
                self._last_words.pop(status.name, None)

    def put_log(self, message: Log) -> None:
        """Take the last words of a node of this limb that ends for a reason of its own."""
        name = "/" + message.name.replace(".", "/")
        if message.level >= FATAL and name in self._own:
            self._last_words[name] = message.msg

    def _forget_nodes(self) -> None:
        """Forget nodes of others that have said nothing for long."""
        oldest = self._clock() - FORGOTTEN
        gone = [name for name, (node, at) in self._nodes.items() if at < oldest and not node["own"]]
        for name in gone:
            del self._nodes[name]
            self._processes.pop(name, None)

    # What is known -------------------------------------------------------------------------

    @property
    def driver_mode(self) -> str:
        """Name of the driver's mode; `SILENT` if it is heard no more, empty if it never was."""
        with self._lock:
            if "driver" not in self._values:
                return ""
            fresh = self._clock() - self._heard["driver"] <= FRESH["driver"]
            return str(self._values["driver"]["mode"]) if fresh else SILENT

    def value_of(self, node: str, key: str) -> str:
        """Return what the newest diagnostics of a node of this limb say under a key, or nothing."""
        with self._lock:
            found = [entry["values"] for entry, _ in self._nodes.values() if entry["own"] == node]
        return str(found[0].get(key, "")) if found else ""

    def reference_at(self, stamp: int) -> tuple[float, float] | None:
        """Return where the tip should be [m] at an instant [ns]; None where no plan says it."""
        with self._lock:
            references = np.array(self._references).reshape(-1, 3)
        stamps, *places = references.T
        if not len(stamps) or not stamps[0] <= stamp <= stamps[-1]:
            return None
        x, y = (float(np.interp(stamp, stamps, axis)) for axis in places)
        return x, y

    @property
    def limit(self) -> float:
        """The driver's largest differential pressure [Pa]; its default before it has said so."""
        return float(self.value_of("pressure_driver", "pressure_limit_pa") or USUAL_LIMIT)

    def snapshot(self) -> dict[str, Any]:
        """Return everything as JSON can carry it: kPa, cm and degrees, None where unknown."""
        with self._lock:
            now = self._clock()
            heard, values = dict(self._heard), dict(self._values)
            self._forget_nodes()
            nodes = [
                _with_age(node, now - at, _trouble(self._processes.get(name, _UNKNOWN)[1]))
                | {
                    "command": self._processes.get(name, _UNKNOWN)[2],
                    "last_words": self._last_words.get(name, ""),
                }
                for name, (node, at) in self._nodes.items()
            ]
        ages = {
            source: {
                "age": _number(now - heard[source], 2) if source in heard else None,
                "limit": limit,
                "fresh": source in heard and now - heard[source] <= limit,
            }
            for source, limit in FRESH.items()
        }
        limb = values.get("tracker")
        found = {
            "sources": ages,
            "driver": values.get("driver"),
            "limb": limb and {**limb, "error_cm": self._tip_error()},
            "plan": self._plan,
            "estimate": values.get("estimate"),
            "contact": values.get("contact"),
            "nodes": worst_first(nodes),
            "missing": missing(nodes),
            "limb_is": describe_limb(values.get("driver")),
        }
        return found | {"alarms": [alarm._asdict() for alarm in alarms(found)]}

    def _tip_error(self) -> float | None:
        """Return the newest tip's distance from its reference [cm]; None where one is missing."""
        if self._tip is None:
            return None
        stamp, tip = self._tip
        reference = self.reference_at(stamp)
        return None if reference is None else _number(math.dist(reference, tip) * CENTIMETRES, 3)


def centimetres(metres: float) -> str:
    """Return a small length [m] for people."""
    length = metres * CENTIMETRES
    return "below 0.01 cm" if length < 0.01 else f"{length:.2f} cm"


def _number(value: float, digits: int) -> float | None:
    return round(value, digits) if math.isfinite(value) else None


def _kilopascal(values: Sequence[float]) -> list[float | None]:
    return [_number(value / PASCAL_PER_KILOPASCAL, 3) for value in values]


def _with_age(node: dict[str, Any], age: float, trouble: str) -> dict[str, Any]:
    """Return what is shown of a node that spoke some seconds ago."""
    shown = {**node, "age": round(age, 1), "trouble": trouble or "nothing is heard of it"}
    if node["message"] == ENDED_IN_ORDER:
        shown["state"] = "ended"
    elif trouble or age > LATE:
        shown["state"] = "dead" if trouble or age > DEAD else "late"
        shown["message"] = trouble or node["message"]
    return shown


def _process(identity: str) -> tuple[psutil.Process | None, str]:
    """Return the process that a node names as ``HOST:NUMBER``, and the command that started it.

    Neither is known of a process that does not run on this computer. One that is not seen here, as
    on another computer or in another container, is never said to have ended.
    """
    host, _, number = identity.rpartition(":")
    if host != socket.gethostname() or not number.isdigit():
        return None, ""
    try:
        process = psutil.Process(int(number))
        return process, as_typed(process.cmdline())
    except psutil.Error:
        return None, ""


def as_typed(words: Sequence[str]) -> str:
    """Return the command by which people start a process; that of a node needs its workspace."""
    for place, word in enumerate(words[:2]):
        *_, library, package, executable = ("", "", "", *Path(word).parts)
        if library == "lib":
            return shlex.join(["scripts/ros2", "run", package, executable, *words[place + 1 :]])
    return shlex.join(words)


def _trouble(process: psutil.Process | None) -> str:
    """Return `ENDED`, `STOPPED`, or an empty text: it runs, or nothing is known of it.

    Diagnostics come once a second, so that their silence tells of a dead node only after more than
    that; the operating system knows at once.
    """
    if process is None:
        return ""
    try:
        # Another process may have got the number since: then this one is not running any more.
        status = process.status() if process.is_running() else psutil.STATUS_DEAD
    except psutil.NoSuchProcess:
        return ENDED
    except psutil.Error:
        return ""
    if status in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD):
        return ENDED
    return STOPPED if status == psutil.STATUS_STOPPED else ""
