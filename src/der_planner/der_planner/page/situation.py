"""What the page knows of the graph, and how old each part of it is."""

from __future__ import annotations

import math
import threading
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from der_planner.page.processes import Processes

PASCAL_PER_KILOPASCAL = 1000.0
CENTIMETRES = 100.0
GRAMS = 1000.0
PERCENT = 100.0
NANOSECONDS = 1_000_000_000
FRESH = {"driver": 0.5, "tracker": 0.5, "camera": 0.7, "estimate": 0.5}
"""[s] that the newest message of a source may be old before the page greys it."""
LATE, DEAD = 1.6, 5.0
"""[s] without diagnostics, which every node sends once a second; a process that has ended on this
computer is dead at once."""
MODES = ("disarmed", "armed", "tracking", "holding", "venting", "fault")
LEVELS = ("ok", "warning", "error", "stale")
REFERENCES_KEPT = 200
GAP = NANOSECONDS // 5
"""[ns] between two references across which none is interpolated: four setpoints of 20 Hz."""


def centimetres(metres: float) -> str:
    """Return a small length [m] for people."""
    length = metres * CENTIMETRES
    return "below 0.01 cm" if length < 0.01 else f"{length:.2f} cm"


@dataclass(frozen=True)
class DriverState:
    """What the driver says at a tick; pressures in Pa, NaN where unknown.

    Attributes:
        mode: number of its mode, an index of `MODES`.
        faults: reasons, worst first.
        plan_id: of the setpoint in force.
        commanded: (M,) differential pressures sent to the board.
        measured: (M,) differential pressures measured.
        supply: absolute pressure of the reservoir.
        telemetry_age: [s] since the board's last telemetry.
    """

    mode: int
    faults: tuple[str, ...]
    plan_id: str
    commanded: tuple[float, ...]
    measured: tuple[float, ...]
    supply: float
    telemetry_age: float


@dataclass(frozen=True)
class LimbView:
    """What the tracker says of one image.

    Attributes:
        stamp: of the image [ns].
        valid: whether the numbers mean anything.
        reason: why not, or what was bridged.
        tip: (2,) [m].
        bend: (M,) bend angles [rad].
        curve: (N, 2) centreline [m], base to tip.
    """

    stamp: int
    valid: bool
    reason: str
    tip: tuple[float, float]
    bend: tuple[float, ...]
    curve: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class PlanView:
    """The newest plan, as the planner published it.

    Attributes:
        motion, model, method, limb: names.
        mounting: in words.
        payload: [kg] that it reckons with beside the limb's own masses.
        payload_at: [m] where, from the clamp; 0: the tip.
        predicted_error: mean of the tip [m].
    """

    motion: str
    model: str
    method: str
    limb: str
    mounting: str
    payload: float
    payload_at: float
    predicted_error: float

    def __str__(self) -> str:
        """Return it as a line for people."""
        carried = ""
        if self.payload:
            place = f"{self.payload_at * CENTIMETRES:.1f} cm from the clamp"
            carried = f", carrying {self.payload * GRAMS:.3g} g at "
            carried += place if self.payload_at else "the tip"
        return (
            f"{self.motion}, {self.model} {self.method}, for the limb '{self.limb}', "
            f"{self.mounting}{carried}; predicted error {centimetres(self.predicted_error)}"
        )


@dataclass(frozen=True)
class EstimateView:
    """What feedback knows beside the shape, one number a segment.

    Attributes:
        missing: effective pressure that the model lacks [Pa].
        missing_sigma: its standard deviation [Pa].
        gain_error: relative error of the model's effective pressure.
        correction: what was added to the newest setpoint [Pa].
        share: 0 to 1 of the correction that acts.
        reason: why feedback is out or going out; empty while it acts.
    """

    missing: tuple[float, ...]
    missing_sigma: tuple[float, ...]
    gain_error: tuple[float, ...]
    correction: tuple[float, ...]
    share: float
    reason: str


@dataclass(frozen=True)
class NodeStatus:
    """The newest diagnostics of a node, an index of `LEVELS` as its level."""

    name: str
    level: int
    message: str
    values: Mapping[str, str] = field(default_factory=dict)


class Situation:
    """The newest of everything, with the instant it came at; safe to use from several threads.

    Args:
        clock: steady [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._heard: dict[str, float] = {}
        self._driver: DriverState | None = None
        self._limb: LimbView | None = None
        self._plan: PlanView | None = None
        self._estimate: EstimateView | None = None
        self._nodes: dict[str, tuple[NodeStatus, float]] = {}
        self._processes = Processes()
        self._references: deque[tuple[int, float, float]] = deque(maxlen=REFERENCES_KEPT)

    def hear(self, source: str) -> None:
        """Note that a source has sent something now."""
        with self._lock:
            self._heard[source] = self._clock()

    def put_driver(self, state: DriverState) -> None:
        """Take the driver's newest state."""
        with self._lock:
            self._driver = state
            self._heard["driver"] = self._clock()

    def put_limb(self, view: LimbView) -> None:
        """Take the tracker's newest view of the limb."""
        with self._lock:
            self._limb = view
            self._heard["tracker"] = self._clock()

    def put_reference(self, stamp: int, x: float, y: float) -> None:
        """Take where the tip should be [m] at an instant [ns], which may lie ahead."""
        with self._lock:
            if self._references and stamp <= self._references[-1][0]:
                self._references.clear()  # a newer plan took over
            self._references.append((stamp, x, y))

    def put_plan(self, plan: PlanView) -> None:
        """Take the newest plan."""
        with self._lock:
            self._plan = plan

    def put_estimate(self, estimate: EstimateView) -> None:
        """Take what feedback knows now."""
        with self._lock:
            self._estimate = estimate
            self._heard["estimate"] = self._clock()

    def put_status(self, status: NodeStatus) -> None:
        """Take a node's diagnostics."""
        with self._lock:
            self._nodes[status.name] = (status, self._clock())
            self._processes.note(status.name, status.values.get("process", ""))

    @property
    def driver_mode(self) -> str:
        """Name of the driver's mode; empty if it has not been heard lately."""
        with self._lock:
            age = self._clock() - self._heard.get("driver", -math.inf)
            if self._driver is None or age > FRESH["driver"]:
                return ""
            return _mode(self._driver)

    def value_of(self, node: str, key: str) -> str:
        """Return what a node's newest diagnostics say under a key; empty where they do not."""
        with self._lock:
            found = [status for status, _ in self._nodes.values() if _short(status.name) == node]
        return found[0].values.get(key, "") if found else ""

    def reference_at(self, stamp: int) -> tuple[float, float] | None:
        """Return where the tip should be [m] at an instant [ns]; None where no plan says it."""
        with self._lock:
            references = list(self._references)
        after = bisect_left(references, (stamp, -math.inf, -math.inf))
        if after == len(references):
            return None
        late, x1, y1 = references[after]
        if late == stamp:
            return x1, y1
        if after == 0:
            return None
        early, x0, y0 = references[after - 1]
        if late - early > GAP:
            return None
        share = (stamp - early) / (late - early)
        return x0 + share * (x1 - x0), y0 + share * (y1 - y0)

    def snapshot(self) -> dict[str, Any]:
        """Return everything as JSON can carry it: kPa, cm and degrees, None where unknown."""
        with self._lock:
            now = self._clock()
            heard, nodes = dict(self._heard), list(self._nodes.values())
            driver, limb = self._driver, self._limb
            plan, estimate = self._plan, self._estimate
            troubles = {status.name: self._processes.trouble(status.name) for status, _ in nodes}
        ages = {
            name: {
                "age": _number(now - heard[name], 2) if name in heard else None,
                "limit": limit,
                "fresh": name in heard and now - heard[name] <= limit,
            }
            for name, limit in FRESH.items()
        }
        return {
            "sources": ages,
            "driver": None if driver is None else _driver_values(driver),
            "limb": None if limb is None else self._limb_values(limb),
            "plan": "" if plan is None else str(plan),
            "estimate": None if estimate is None else _estimate_values(estimate),
            "nodes": [
                _node_values(status, now - at, troubles[status.name])
                for status, at in sorted(nodes, key=_name)
            ],
        }

    def _limb_values(self, limb: LimbView) -> dict[str, Any]:
        reference = self.reference_at(limb.stamp) if limb.valid else None
        error = None
        if reference is not None:
            error = _number(math.dist(reference, limb.tip) * CENTIMETRES, 3)
        return {
            "valid": limb.valid,
            "reason": limb.reason,
            "tip_cm": [_number(value * CENTIMETRES, 2) for value in limb.tip],
            "bend_deg": [_number(math.degrees(value), 2) for value in limb.bend],
            "error_cm": error,
        }


def _short(name: str) -> str:
    return name.rsplit("/", 1)[-1]


def _name(entry: tuple[NodeStatus, float]) -> str:
    return entry[0].name


def _number(value: float, digits: int) -> float | None:
    return round(value, digits) if math.isfinite(value) else None


def _kilopascal(values: Sequence[float]) -> list[float | None]:
    return [_number(value / PASCAL_PER_KILOPASCAL, 3) for value in values]


def _mode(driver: DriverState) -> str:
    known = 0 <= driver.mode < len(MODES)
    return MODES[driver.mode] if known else f"unknown mode {driver.mode}"


def _driver_values(driver: DriverState) -> dict[str, Any]:
    return {
        "mode": _mode(driver),
        "faults": list(driver.faults),
        "plan_id": driver.plan_id,
        "commanded_kpa": _kilopascal(driver.commanded),
        "measured_kpa": _kilopascal(driver.measured),
        "supply_kpa": _number(driver.supply / PASCAL_PER_KILOPASCAL, 1),
        "telemetry_age": _number(driver.telemetry_age, 2),
    }


def _estimate_values(estimate: EstimateView) -> dict[str, Any]:
    return {
        "missing_kpa": _kilopascal(estimate.missing),
        "missing_sigma_kpa": _kilopascal(estimate.missing_sigma),
        "gain_error_percent": [_number(error * PERCENT, 1) for error in estimate.gain_error],
        "correction_kpa": _kilopascal(estimate.correction),
        "share_percent": _number(estimate.share * PERCENT, 0),
        "reason": estimate.reason,
    }


def _node_values(status: NodeStatus, age: float, trouble: str) -> dict[str, Any]:
    level = LEVELS[status.level] if 0 <= status.level < len(LEVELS) else "error"
    if trouble or age > LATE:
        level = "dead" if trouble or age > DEAD else "late"
    return {
        "name": _short(status.name),
        "state": level,
        "message": trouble or status.message,
        "age": round(age, 1),
        "values": dict(status.values),
    }
