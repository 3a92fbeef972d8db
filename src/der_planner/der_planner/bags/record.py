"""What a bag holds of each limb: topics found by type, limbs by namespace, stamps as they are.

Everything of one limb lies in one namespace; a plan is never paired with the state of another limb.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from der_planner.bags.columns import Columns
from der_planner.bags.corrections import Revisions
from der_planner.bags.reader import BagError, BagReader
from der_planner.bags.run import Array

NANOSECONDS = 1_000_000_000
PLAN_TYPE = "der_msgs/msg/PressurePlan"
SETPOINT_TYPE = "der_msgs/msg/PressureSetpoint"
PRESSURE_TYPE = "der_msgs/msg/PressureState"
STATE_TYPE = "der_msgs/msg/LimbState"
ESTIMATE_TYPE = "der_msgs/msg/LimbEstimate"
TRUTH_SUFFIX = "twin/ground_truth"
BOARD_SUFFIX = "twin/board_commands"
FAULT_MODE = 5
MOST_FAULTS = 1000


@dataclass
class LimbRecord:
    """What a bag holds of one limb: plain numbers of its messages, stamps as integer ns.

    Attributes:
        plans: by id, each with its stamp [ns].
        setpoints: by plan id: differential pressures [Pa].
        setpoint_indices: by plan id, in the order of ``setpoints``.
        revised: ids of the plans of which a setpoint was revised.
        revisions: by plan id: those setpoints, with what their estimates had seen.
        tip, angles: measured tip [m] and bend angles [rad], NaN where the limb was not seen.
        covariance: of the measured tip [m²], row by row.
        truth: simulated tip [m] (twin only).
        commanded, measured: differential pressures [Pa].
        faults: reasons of the driver with their stamps [ns].
        board: commands as the board received them [Pa] (twin only).
    """

    plans: dict[str, tuple[int, Any]] = field(default_factory=dict)
    setpoints: dict[str, Columns] = field(default_factory=dict)
    setpoint_indices: dict[str, array[int]] = field(default_factory=dict)
    revised: set[str] = field(default_factory=set)
    revisions: dict[str, Revisions] = field(default_factory=dict)
    tip: Columns = field(default_factory=lambda: Columns(2))
    angles: Columns = field(default_factory=Columns)
    covariance: Columns = field(default_factory=lambda: Columns(4))
    truth: Columns = field(default_factory=lambda: Columns(2))
    commanded: Columns = field(default_factory=Columns)
    measured: Columns = field(default_factory=Columns)
    faults: list[tuple[int, str]] = field(default_factory=list)
    board: Columns = field(default_factory=Columns)

    @property
    def usable_plans(self) -> dict[str, tuple[int, Any]]:
        """The plans of two setpoints or more, by id."""
        return {name: entry for name, entry in self.plans.items() if len(entry[1].time) > 1}

    def seen(self) -> NDArray[np.int64]:
        """Return the stamps (K,) of the pictures on which the tip was seen [ns]."""
        seen: NDArray[np.int64] = self.tip.stamps()[np.isfinite(self.tip.values(2)).all(axis=1)]
        return seen


@dataclass(frozen=True)
class BagRecord:
    """The content of a bag that becomes arrays.

    Attributes:
        path: of the bag.
        limbs: by the namespace of their topics, e.g. ``/limb``; a bag may hold several.
        run: what the recorder was told of the run.
    """

    path: Path
    limbs: dict[str, LimbRecord]
    run: dict[str, Any]

    @property
    def played(self) -> list[str]:
        """Namespaces of the limbs that have a plan."""
        return [name for name, limb in self.limbs.items() if limb.usable_plans]


def read_record(path: str | Path, *, progress: Callable[[float], None] | None = None) -> BagRecord:
    """Read everything of a bag that becomes arrays, limb by limb.

    Args:
        path: bag folder or file.
        progress: called with the fraction of the bag's time that was read.

    Raises:
        BagError: the bag cannot be read.
    """
    with BagReader(path) as bag:
        try:
            limbs = _collect(bag, progress)
        except BagError:
            raise
        except Exception as error:  # rosbags raises many kinds for damaged content
            raise BagError(
                f"the bag {path} is damaged: {error}. scripts/recover_bag.py {path} saves what is "
                "whole"
            ) from error
        return BagRecord(Path(path), limbs, bag.run())


def namespace_of(topic: str) -> str:
    """Return the namespace of the limb that a plan, a state, a pressure or a truth belongs to."""
    levels = 2 if topic.endswith((TRUTH_SUFFIX, BOARD_SUFFIX)) else 1
    return topic.rsplit("/", levels)[0] or "/"


def header_stamp(message: Any) -> int:
    """Return the stamp of a recorded message [ns]."""
    return int(message.header.stamp.sec) * NANOSECONDS + int(message.header.stamp.nanosec)


def _collect(bag: BagReader, progress: Callable[[float], None] | None) -> dict[str, LimbRecord]:
    """Return what the bag holds of each limb; every topic counts for its own namespace only."""
    limbs: dict[str, LimbRecord] = {}
    handlers: dict[str, tuple[LimbRecord, Callable[[LimbRecord, Any], None]]] = {}
    for name, topic in bag.topics.items():
        take = _taker(name, topic.type_name)
        if take is not None:
            limb = limbs.setdefault(namespace_of(name), LimbRecord())
            handlers[name] = (limb, take)
    begin, length = bag.start, max(1, bag.end - bag.start)
    for count, (name, log_time, message) in enumerate(bag.messages(list(handlers))):
        limb, take = handlers[name]
        take(limb, message)
        if progress is not None and count % 1000 == 0:
            progress((log_time - begin) / length)
    return limbs


def _taker(topic: str, type_name: str) -> Callable[[LimbRecord, Any], None] | None:
    """Return what takes the messages of a topic; None for a topic that becomes no array."""
    if topic.endswith(TRUTH_SUFFIX):
        return _take_truth
    if topic.endswith(BOARD_SUFFIX):
        return _take_board
    return {
        PLAN_TYPE: _take_plan,
        SETPOINT_TYPE: _take_setpoint,
        PRESSURE_TYPE: _take_pressure,
        STATE_TYPE: _take_state,
        ESTIMATE_TYPE: _take_estimate,
    }.get(type_name)


def _take_plan(limb: LimbRecord, message: Any) -> None:
    limb.plans[message.plan_id] = (header_stamp(message), message)


def _take_setpoint(limb: LimbRecord, message: Any) -> None:
    of_plan = limb.setpoints.setdefault(message.plan_id, Columns())
    of_plan.append(header_stamp(message), message.differential_pressure)
    limb.setpoint_indices.setdefault(message.plan_id, array("q")).append(int(message.index))
    if message.revision:
        limb.revised.add(message.plan_id)
        _, plan = limb.plans.get(message.plan_id, (0, None))
        planned = () if plan is None else planned_commands(plan)
        if message.index < len(planned):
            added = np.asarray(message.differential_pressure) - planned[message.index]
            limb.revisions.setdefault(message.plan_id, Revisions()).revised(
                header_stamp(message), added
            )


def _take_estimate(limb: LimbRecord, message: Any) -> None:
    picture = header_stamp(message) - round(message.age * NANOSECONDS)
    revisions = limb.revisions.get(message.plan_id)
    if revisions is not None:
        revisions.estimated(picture, np.asarray(message.correction))


def _take_state(limb: LimbRecord, message: Any) -> None:
    stamp, valid = header_stamp(message), bool(message.valid)
    limb.tip.append(stamp, (message.tip.x, message.tip.y) if valid else ())
    limb.angles.append(stamp, message.bend_angle if valid else ())
    limb.covariance.append(stamp, message.tip_covariance if valid else ())


def _take_truth(limb: LimbRecord, message: Any) -> None:
    if message.valid:
        limb.truth.append(header_stamp(message), (message.tip.x, message.tip.y))


def _take_pressure(limb: LimbRecord, message: Any) -> None:
    stamp = header_stamp(message)
    limb.commanded.append(stamp, message.commanded_differential)
    limb.measured.append(stamp, message.measured_differential)
    if message.mode == FAULT_MODE:
        new = [(stamp, reason) for reason in message.faults or ["fault"]]
        limb.faults += [entry for entry in new if len(limb.faults) < MOST_FAULTS]


def _take_board(limb: LimbRecord, message: Any) -> None:
    chambers = np.asarray(message.pressure)
    limb.board.append(header_stamp(message), chambers[0::2] - chambers[1::2])


def planned_commands(plan: Any) -> Array:
    """Return the commands (K, M) of a plan's message [Pa]."""
    return np.array(plan.differential_pressure, dtype=float).reshape(-1, int(plan.segment_count))
