"""The only way from a bag to arrays: topics found by type, limbs by namespace, times by stamps.

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

from der_planner.runs.columns import Columns
from der_planner.runs.corrections import Revisions, described, latencies
from der_planner.runs.recording.reader import BagError, BagReader
from der_planner.runs.run import (
    Array,
    BoardLog,
    Description,
    EvaluationError,
    RunSeries,
    Stream,
    method_name,
)

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


def load_run(
    path: str | Path,
    *,
    plan_id: str = "",
    namespace: str = "",
    progress: Callable[[float], None] | None = None,
) -> RunSeries:
    """Read one run from its bag.

    Args:
        path: bag folder or file.
        plan_id: which plan of the bag; the one with the most recorded setpoints if empty.
        namespace: of the limb, e.g. ``/limb``; needed only where limbs of several have plans.
        progress: called with the fraction of the bag's time that was read.

    Raises:
        EvaluationError: the bag has no plan, or no limb state while it was played, or several
            limbs have plans and none is named.
        BagError: the bag cannot be read.
    """
    record = read_record(path, progress=progress)
    return run_of(record, _choose_limb(record, namespace, plan_id), plan_id)


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
        planned = () if plan is None else _planned(plan)
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


@dataclass(frozen=True)
class _Setpoints:
    """Setpoints of one plan in the order of their indices, each as it was revised last."""

    index: NDArray[np.int64]
    stamp: NDArray[np.int64]
    value: Array


def _setpoints(limb: LimbRecord, plan_id: str, segment_count: int) -> _Setpoints:
    if plan_id not in limb.setpoints:
        none = np.empty(0, dtype=np.int64)
        return _Setpoints(none, none, np.empty((0, segment_count)))
    rows = limb.setpoints[plan_id]
    backward = np.array(limb.setpoint_indices[plan_id])[::-1]
    index, last = np.unique(backward, return_index=True)
    last = len(backward) - 1 - last
    return _Setpoints(index, rows.stamps()[last], rows.values(segment_count)[last])


def _feedback(limb: LimbRecord, plan: Any, setpoints: _Setpoints) -> dict[str, Any]:
    """Return what feedback did to a plan's setpoints, by the key of a run's `extra`."""
    planned = _planned(plan)
    usable = setpoints.index < len(planned)
    added = setpoints.value[usable] - planned[setpoints.index[usable]]
    if not len(added):
        return {}
    taken = latencies(limb.revisions.get(plan.plan_id, Revisions()), limb.seen())
    return {"feedback": described(added, taken)}


def _planned(plan: Any) -> Array:
    """Return the commands (K, M) of a plan's message [Pa]."""
    return np.array(plan.differential_pressure, dtype=float).reshape(-1, int(plan.segment_count))


def run_of(record: BagRecord, namespace: str, plan_id: str = "") -> RunSeries:
    """Return the run of one limb of a bag.

    Args:
        record: of the bag.
        namespace: of the limb, one of ``record.limbs``.
        plan_id: which plan; the one with the most recorded setpoints if empty.

    Raises:
        EvaluationError: this limb has no such plan, or no state while it was played.
    """
    limb, where = record.limbs[namespace], _place(record, namespace)
    chosen = _choose_plan(limb, where, plan_id)
    stamp, plan = limb.plans[chosen]
    segment_count = int(plan.segment_count)
    setpoints = _setpoints(limb, chosen, segment_count)
    times = np.array(plan.time)
    origin = _origin(stamp, times, setpoints)
    if origin == 0:
        raise EvaluationError(
            f"{where}: the plan '{chosen}' carries no stamp and none of its setpoints was recorded"
        )
    about = _feedback(limb, plan, setpoints) if chosen in limb.revised else {}
    end = times[-1]
    played = int(setpoints.index[-1]) if len(setpoints.index) else len(times) - 1
    faults = [text for when, text in limb.faults if 0 <= (when - origin) / NANOSECONDS <= end]
    tip = stream(limb.tip, 2, origin)
    if not len(tip) or tip.time[-1] < 0 or tip.time[0] > end:
        raise EvaluationError(
            f"{where}: no limb state was recorded while the plan was played: did the tracker run?"
            f"{_others_seen(record, namespace)}"
        )
    return RunSeries(
        description=_describe(plan, record, namespace, about),
        reference=Stream(times, np.array(plan.tip_reference).reshape(-1, 2)),
        predicted=Stream(times, np.array(plan.tip_predicted).reshape(-1, 2)),
        tip=tip,
        bend_angle=stream(limb.angles, segment_count, origin),
        tip_covariance=stream(limb.covariance, 4, origin),
        setpoints=Stream(times, _commands(plan, setpoints)),
        commanded=stream(limb.commanded, segment_count, origin),
        measured=stream(limb.measured, segment_count, origin),
        truth=stream(limb.truth, 2, origin) if len(limb.truth) else None,
        board=_board(limb, setpoints, origin),
        faults=tuple(dict.fromkeys(faults)),
        finished=played == len(times) - 1 and tip.time[-1] >= end - 1.0,
        origin=origin,
    )


def _commands(plan: Any, setpoints: _Setpoints) -> Array:
    """Return the commands (K, M) [Pa] as they were sent; as planned where none was recorded."""
    command = np.array(plan.differential_pressure, dtype=float)
    command = command.reshape(len(plan.time), -1).copy()
    known = setpoints.index < len(command)
    known &= np.isfinite(setpoints.value).all(axis=1)
    command[setpoints.index[known]] = setpoints.value[known]
    return command


def stream(columns: Columns, width: int, origin: int) -> Stream:
    """Return rows in the order of their stamps, each stamp once, times [s] since ``origin`` [ns].

    Args:
        columns: rows with stamps [ns].
        width: numbers in a row; NaN throughout where the rows have another width.
        origin: instant that becomes time 0 [ns].
    """
    stamps, first = np.unique(columns.stamps(), return_index=True)
    return Stream((stamps - origin) / NANOSECONDS, columns.values(width)[first])


def _place(record: BagRecord, namespace: str) -> str:
    """Return a name of the limb for messages: the bag, and the namespace where it has several."""
    return f"{record.path}, {namespace}" if len(record.limbs) > 1 else str(record.path)


def _others_seen(record: BagRecord, namespace: str) -> str:
    others = [name for name, limb in record.limbs.items() if name != namespace and len(limb.tip)]
    if not others:
        return ""
    return f" (The states of {', '.join(sorted(others))} are another limb's and do not count.)"


def _choose_limb(record: BagRecord, namespace: str, plan_id: str) -> str:
    if namespace:
        if namespace not in record.limbs:
            known = ", ".join(sorted(record.limbs)) or "none"
            raise EvaluationError(f"{record.path}: no limb {namespace}, only {known}")
        return namespace
    played = record.played
    if plan_id:
        named = [name for name in played if plan_id in record.limbs[name].usable_plans]
        played = named or played
    if not played:
        raise EvaluationError(
            f"{record.path}: holds no {PLAN_TYPE}: was the recorder started before the planner "
            "planned?"
        )
    if len(played) > 1:
        raise EvaluationError(
            f"{record.path}: holds runs of several limbs, {', '.join(sorted(played))}: name one"
        )
    return played[0]


def _choose_plan(limb: LimbRecord, where: str, plan_id: str) -> str:
    usable = limb.usable_plans
    if not usable:
        raise EvaluationError(
            f"{where}: holds no {PLAN_TYPE}: was the recorder started before the planner planned?"
        )
    if plan_id:
        if plan_id not in usable:
            raise EvaluationError(f"{where}: no plan '{plan_id}', only {', '.join(sorted(usable))}")
        return plan_id
    return max(usable, key=lambda name: (len(limb.setpoints.get(name, ())), usable[name][0]))


def _origin(stamp: int, times: Array, setpoints: _Setpoints) -> int:
    """Return the instant of the first setpoint [ns]: of the setpoints played, else of the plan."""
    usable = (setpoints.stamp > 0) & (setpoints.index < len(times))
    if not usable.any():
        return stamp
    planned = np.rint(times[setpoints.index[usable]] * NANOSECONDS).astype(np.int64)
    starts = np.sort(setpoints.stamp[usable] - planned)
    return int(starts[len(starts) // 2])  # a mean of int64 stamps would lose nanoseconds


def _board(limb: LimbRecord, setpoints: _Setpoints, origin: int) -> BoardLog | None:
    if not len(limb.board) or not len(setpoints.index):
        return None
    stamps = limb.board.stamps()
    return BoardLog(
        setpoint_time=(setpoints.stamp - origin) / NANOSECONDS,
        setpoint=setpoints.value,
        command_time=(stamps - origin) / NANOSECONDS,
        command=limb.board.values(setpoints.value.shape[1]),
    )


def _loads(plan: Any) -> dict[str, Any]:
    """Return the loads of a plan by the fields of `Description`; older bags name none."""
    x, y, z = (float(value) for value in getattr(plan, "gravity", (0.0, 0.0, 0.0)))
    return {
        "gravity": (x, y, z),
        "payload": float(getattr(plan, "payload", 0.0)),
        "payload_at": float(getattr(plan, "payload_at", 0.0)),
    }


def _describe(
    plan: Any, record: BagRecord, namespace: str, feedback: dict[str, Any]
) -> Description:
    known = {"motion", "model", "method", "trial", "seed", "limb"}
    run = record.run
    # A plan along a path is named "path"; the recorder was told which one.
    drawn = plan.motion in ("", "path")
    return Description(
        motion=(run.get("motion") if drawn else "") or plan.motion,
        model=plan.model or run.get("model", ""),
        method=method_name(plan.method or run.get("method", ""), run.get("learned_from")),
        trial=int(run.get("trial", -1)),
        seed=int(run.get("seed", -1)),
        amplitude=float(plan.amplitude),
        period=float(plan.period),
        cycles=int(plan.cycles),
        limb=str(plan.limb or run.get("limb", "")),
        bag=str(record.path),
        namespace=namespace,
        **_loads(plan),
        extra={**{key: value for key, value in run.items() if key not in known}, **feedback},
    )
