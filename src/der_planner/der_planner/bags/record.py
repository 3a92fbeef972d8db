"""What a bag holds of each limb: topics found by type, limbs by namespace, stamps as they are.

Everything of one limb lies in one namespace; a plan is never paired with the state of another limb.
"""

from __future__ import annotations

import math
from array import array
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.bags.reader import BagError, BagReader

NANOSECONDS = 1_000_000_000
PLAN_TYPE = "der_msgs/msg/PressurePlan"
SETPOINT_TYPE = "der_msgs/msg/PressureSetpoint"
PRESSURE_TYPE = "der_msgs/msg/PressureState"
STATE_TYPE = "der_msgs/msg/LimbState"
ESTIMATE_TYPE = "der_msgs/msg/LimbEstimate"
CONTACT_TYPE = "der_msgs/msg/LimbContact"
DIAGNOSTICS_TYPE = "diagnostic_msgs/msg/DiagnosticArray"
TRUTH_SUFFIX = "twin/ground_truth"
BOARD_SUFFIX = "twin/board_commands"
FAULT_MODE = 5
_SAME = 1e-6
"""Pressures that differ by less are the same number, written twice [Pa]."""
_LOOK_BACK = 40
"""An estimate belongs to one of so many revisions before it."""


class Columns:
    """Rows of a stamp [ns] and some numbers, appended one by one: 8 bytes a number.

    Rows may be empty: a board that has not measured yet, a limb that was not seen.
    """

    def __init__(self) -> None:
        self._rows: list[tuple[int, array[float]]] = []

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def width(self) -> int:
        """Numbers in the first row that is not empty; 0 without any."""
        return next((len(numbers) for _, numbers in self._rows if numbers), 0)

    def append(self, stamp: int, values: Iterable[float]) -> None:
        """Add a row."""
        self._rows.append((stamp, array("d", values)))

    def stamps(self) -> NDArray[np.int64]:
        """Return (N,) stamps [ns]."""
        return np.array([stamp for stamp, _ in self._rows], dtype=np.int64)

    def values(self, width: int) -> Array:
        """Return (N, width) numbers; NaN in rows of another width."""
        unknown = array("d", [math.nan] * width)
        rows = [each if len(each) == width else unknown for _, each in self._rows]
        return np.array(rows, dtype=float).reshape(-1, width)


@dataclass
class Revisions:
    """The revised setpoints of a plan, and the estimates that they rest on, as they were logged.

    Attributes:
        stamps: instants at which the revised setpoints take effect [ns].
        added: (M,) of each: the setpoint less the plan's [Pa].
        pictures: of each revision, the newest picture that it knows of [ns]; None: not told.
        warnings: why feedback was out, each reason once.
    """

    stamps: list[int] = field(default_factory=list)
    added: list[Array] = field(default_factory=list)
    pictures: list[int | None] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def revised(self, stamp: int, added: Array) -> None:
        """Add a revised setpoint."""
        self.stamps.append(stamp)
        self.added.append(added)
        self.pictures.append(None)

    def estimated(self, picture: int, correction: Array) -> None:
        """Find the revision that was published with an estimate, by what both say was added.

        Args:
            picture: the newest picture that the estimate knows of [ns].
            correction: (M,) that it says was added [Pa].
        """
        if not np.any(correction):
            return
        for place in range(len(self.stamps) - 1, max(-1, len(self.stamps) - _LOOK_BACK), -1):
            same = len(self.added[place]) == len(correction)
            if same and np.abs(self.added[place] - correction).max() < _SAME:
                self.pictures[place] = picture
                return


@dataclass
class LimbRecord:
    """What a bag holds of one limb: plain numbers of its messages, stamps as integer ns.

    Attributes:
        plans: by id, each with its stamp [ns].
        setpoints: by plan id: their indices, then their differential pressures [Pa].
        revisions: by plan id: its revised setpoints, with what their estimates had seen.
        tip, angles: measured tip [m] and bend angles [rad], empty rows where the limb was not seen.
        covariance: of the measured tip [m²], row by row.
        truth: simulated tip [m] (twin only).
        commanded, measured: differential pressures [Pa].
        faults: reasons of the driver with their stamps [ns].
        touches: by plan id and when one began [ns]: how far it was from a free limb, what it said.
        board: pressures of the valves (2M,) as the board received them [Pa] (twin only).
        ahead: by which a state or pressure is stamped later than it arrived, at the most [ns].
    """

    plans: dict[str, tuple[int, Any]] = field(default_factory=dict)
    setpoints: dict[str, Columns] = field(default_factory=lambda: defaultdict(Columns))
    revisions: dict[str, Revisions] = field(default_factory=lambda: defaultdict(Revisions))
    tip: Columns = field(default_factory=Columns)
    angles: Columns = field(default_factory=Columns)
    covariance: Columns = field(default_factory=Columns)
    truth: Columns = field(default_factory=Columns)
    commanded: Columns = field(default_factory=Columns)
    measured: Columns = field(default_factory=Columns)
    faults: list[tuple[int, str]] = field(default_factory=list)
    touches: dict[tuple[str, int], tuple[float, str]] = field(default_factory=dict)
    board: Columns = field(default_factory=Columns)
    ahead: int = 0

    @property
    def usable_plans(self) -> dict[str, tuple[int, Any]]:
        """The plans of two setpoints or more, by id."""
        return {name: entry for name, entry in self.plans.items() if len(entry[1].time) > 1}

    def seen(self) -> NDArray[np.int64]:
        """Return the stamps (K,) of the pictures on which the tip was seen [ns]."""
        seen: NDArray[np.int64] = self.tip.stamps()[np.isfinite(self.tip.values(2)).all(axis=1)]
        return seen

    def add_plan(self, message: Any) -> None:
        """Add a `PressurePlan`."""
        self.plans[message.plan_id] = (header_stamp(message), message)

    def add_setpoint(self, message: Any) -> None:
        """Add a `PressureSetpoint`."""
        name, stamp = message.plan_id, header_stamp(message)
        self.setpoints[name].append(stamp, (message.index, *message.differential_pressure))
        if message.revision and name in self.plans:
            planned = planned_commands(self.plans[name][1])
            if message.index < len(planned):
                added = np.asarray(message.differential_pressure) - planned[message.index]
                self.revisions[name].revised(stamp, added)

    def add_estimate(self, message: Any) -> None:
        """Add a `LimbEstimate`."""
        picture = header_stamp(message) - round(message.age * NANOSECONDS)
        revisions = self.revisions[message.plan_id]
        revisions.estimated(picture, np.asarray(message.correction))
        if message.reason and message.reason not in revisions.warnings:
            revisions.warnings.append(message.reason)

    def add_contact(self, message: Any) -> None:
        """Add a `LimbContact`: of each touch the one that was surest."""
        name = message.plan_id, nanoseconds_of(message.since)
        if message.touched and message.distance > self.touches.get(name, (0.0, ""))[0]:
            self.touches[name] = float(message.distance), message.said

    def add_state(self, message: Any) -> None:
        """Add a `LimbState` of the tracker."""
        stamp, valid = header_stamp(message), bool(message.valid)
        self.tip.append(stamp, (message.tip.x, message.tip.y) if valid else ())
        self.angles.append(stamp, message.bend_angle if valid else ())
        self.covariance.append(stamp, message.tip_covariance if valid else ())

    def add_truth(self, message: Any) -> None:
        """Add a `LimbState` of the twin itself."""
        if message.valid:
            self.truth.append(header_stamp(message), (message.tip.x, message.tip.y))

    def add_pressure(self, message: Any) -> None:
        """Add a `PressureState`."""
        stamp = header_stamp(message)
        self.commanded.append(stamp, message.commanded_differential)
        self.measured.append(stamp, message.measured_differential)
        if message.mode == FAULT_MODE:
            self.faults += [(stamp, reason) for reason in message.faults or ["fault"]]

    def add_board(self, message: Any) -> None:
        """Add the `ChamberPressures` of a command that the twin's board received."""
        self.board.append(header_stamp(message), message.pressure)


@dataclass(frozen=True)
class BagRecord:
    """The content of a bag that becomes arrays.

    Attributes:
        path: of the bag.
        limbs: by the namespace of their topics, e.g. ``/limb``; a bag may hold several.
        run: what the recorder was told of the run, and ``clocks``: how far each node's was off.
    """

    path: Path
    limbs: dict[str, LimbRecord]
    run: dict[str, Any]

    @property
    def played(self) -> list[str]:
        """Namespaces of the limbs that have a plan."""
        return [name for name, limb in self.limbs.items() if limb.usable_plans]

    def limb_named(self, namespace: str, among: Collection[str]) -> str:
        """Return the namespace of the limb that is meant; empty where the bag holds none.

        Args:
            namespace: as the user names it; empty: the only one of ``among``.
            among: limbs of this bag that hold what is asked for.

        Raises:
            BagError: the bag has no such limb, or several are left and none is named.
        """
        if namespace and namespace not in self.limbs:
            known = ", ".join(sorted(self.limbs)) or "none"
            raise BagError(f"{self.path}: no limb {namespace}, only {known}")
        if not namespace and len(among) > 1:
            raise BagError(
                f"{self.path}: holds several limbs, {', '.join(sorted(among))}: name one with "
                "--namespace"
            )
        return namespace or next(iter(among or self.limbs), "")


def read_record(path: str | Path) -> BagRecord:
    """Read everything of a bag that becomes arrays, limb by limb.

    Args:
        path: bag folder or file.

    Raises:
        BagError: the bag cannot be read.
    """
    with BagReader(path) as bag:
        try:
            limbs, clocks = _collect(bag)
        except Exception as error:  # rosbags raises many kinds for damaged content
            raise BagError(
                f"the bag {path} is damaged: {error}. scripts/recover_bag.py {path} saves what is "
                "whole"
            ) from error
        return BagRecord(Path(path), limbs, bag.run() | ({"clocks": clocks} if clocks else {}))


def namespace_of(topic: str) -> str:
    """Return the namespace of the limb that a plan, a state, a pressure or a truth belongs to."""
    levels = 2 if topic.endswith((TRUTH_SUFFIX, BOARD_SUFFIX)) else 1
    return topic.rsplit("/", levels)[0] or "/"


def header_stamp(message: Any) -> int:
    """Return the stamp of a recorded message [ns]."""
    return nanoseconds_of(message.header.stamp)


def nanoseconds_of(stamp: Any) -> int:
    """Return a recorded stamp [ns]."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def _collect(bag: BagReader) -> tuple[dict[str, LimbRecord], str]:
    """Return what the bag holds of each limb, and what its nodes said last of their clocks.

    Every topic counts for its own namespace only.
    """
    limbs: dict[str, LimbRecord] = {}
    receivers: dict[str, Callable[[Any], None]] = {}
    watchers: dict[str, LimbRecord] = {}
    clocks: dict[str, str] = {}
    for name, topic in bag.topics.items():
        method = _method(name, topic.type_name)
        if method is not None:
            limb = limbs.setdefault(namespace_of(name), LimbRecord())
            receivers[name] = partial(method, limb)
            if method in (LimbRecord.add_state, LimbRecord.add_pressure):
                watchers[name] = limb
        elif topic.type_name == DIAGNOSTICS_TYPE:
            receivers[name] = partial(_note_clocks, clocks)
    for name, arrival, message in bag.messages(list(receivers)):
        receivers[name](message)
        if name in watchers:
            watchers[name].ahead = max(watchers[name].ahead, header_stamp(message) - arrival)
    return limbs, ", ".join(f"{node} {offset}" for node, offset in sorted(clocks.items()))


def _note_clocks(clocks: dict[str, str], message: Any) -> None:
    """Take what nodes say of their clocks in a `DiagnosticArray`, in ms of the driver's."""
    for status in message.status:
        told = {pair.key: pair.value for pair in status.values}
        if "clock_uncertainty_s" in told:  # a node of ours
            offset, error = (1e3 * float(told[f"clock_{n}_s"]) for n in ("offset", "uncertainty"))
            clocks[status.name] = f"{-offset:+.2f} ± {error:.2f} ms"


def _method(topic: str, type_name: str) -> Callable[[LimbRecord, Any], None] | None:
    """Return what adds the messages of a topic; None for a topic that becomes no array."""
    if topic.endswith(TRUTH_SUFFIX):
        return LimbRecord.add_truth
    if topic.endswith(BOARD_SUFFIX):
        return LimbRecord.add_board
    return {
        PLAN_TYPE: LimbRecord.add_plan,
        SETPOINT_TYPE: LimbRecord.add_setpoint,
        PRESSURE_TYPE: LimbRecord.add_pressure,
        STATE_TYPE: LimbRecord.add_state,
        ESTIMATE_TYPE: LimbRecord.add_estimate,
        CONTACT_TYPE: LimbRecord.add_contact,
    }.get(type_name)


def planned_commands(plan: Any) -> Array:
    """Return the commands (K, M) of a plan's message [Pa]."""
    return np.array(plan.differential_pressure, dtype=float).reshape(-1, int(plan.segment_count))
