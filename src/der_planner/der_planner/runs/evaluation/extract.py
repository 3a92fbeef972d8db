"""From a bag to a `RunSeries`: topics found by type, times by stamps, nothing guessed."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from der_planner.runs.evaluation.columns import Columns
from der_planner.runs.evaluation.series import (
    Array,
    BoardLog,
    Description,
    EvaluationError,
    RunSeries,
    Stream,
)
from der_planner.runs.recording.reader import BagError, BagReader

NANOSECONDS = 1_000_000_000
PLAN_TYPE = "der_msgs/msg/PressurePlan"
SETPOINT_TYPE = "der_msgs/msg/PressureSetpoint"
PRESSURE_TYPE = "der_msgs/msg/PressureState"
STATE_TYPE = "der_msgs/msg/LimbState"
CHAMBERS_TYPE = "der_msgs/msg/ChamberPressures"
TRUTH_SUFFIX = "twin/ground_truth"
BOARD_SUFFIX = "twin/board_commands"
FAULT_MODE = 5
MOST_FAULTS = 1000


@dataclass
class _Collected:
    """Plain numbers of the messages of interest; stamps as integer ns."""

    plans: dict[str, tuple[int, Any]] = field(default_factory=dict)
    setpoints: dict[str, Columns] = field(default_factory=dict)
    setpoint_indices: dict[str, array[int]] = field(default_factory=dict)
    tip: Columns = field(default_factory=lambda: Columns(2))
    angles: Columns = field(default_factory=Columns)
    truth: Columns = field(default_factory=lambda: Columns(2))
    commanded: Columns = field(default_factory=Columns)
    measured: Columns = field(default_factory=Columns)
    faults: list[tuple[int, str]] = field(default_factory=list)
    board: Columns = field(default_factory=Columns)


def load_run(
    path: str | Path, *, plan_id: str = "", progress: Callable[[float], None] | None = None
) -> RunSeries:
    """Read one run from its bag.

    Args:
        path: bag folder or file.
        plan_id: which plan of the bag; the one with the most recorded setpoints if empty.
        progress: called with the fraction of the bag's time that was read.

    Raises:
        EvaluationError: the bag has no plan, or no limb state while it was played.
        BagError: the bag cannot be read.
    """
    with BagReader(path) as bag:
        try:
            found = _collect(bag, progress)
        except BagError:
            raise
        except Exception as error:  # rosbags raises many kinds for damaged content
            raise BagError(
                f"the bag {path} is damaged: {error}. scripts/recover_bag.py {path} saves what is "
                "whole"
            ) from error
        run = bag.run()
    return _series(found, run, Path(path), plan_id)


def _stamp(message: Any) -> int:
    return int(message.header.stamp.sec) * NANOSECONDS + int(message.header.stamp.nanosec)


def _collect(bag: BagReader, progress: Callable[[float], None] | None) -> _Collected:
    found = _Collected()
    handlers: dict[str, Callable[[_Collected, Any], None]] = {}
    by_type = {
        PLAN_TYPE: _take_plan,
        SETPOINT_TYPE: _take_setpoint,
        PRESSURE_TYPE: _take_pressure,
    }
    for name, topic in bag.topics.items():
        if name.endswith(TRUTH_SUFFIX):
            handlers[name] = _take_truth
        elif name.endswith(BOARD_SUFFIX):
            handlers[name] = _take_board
        elif topic.type_name == STATE_TYPE:
            handlers[name] = _take_state
        elif topic.type_name in by_type:
            handlers[name] = by_type[topic.type_name]
    begin, length = bag.start, max(1, bag.end - bag.start)
    for count, (name, log_time, message) in enumerate(bag.messages(list(handlers))):
        handlers[name](found, message)
        if progress is not None and count % 1000 == 0:
            progress((log_time - begin) / length)
    return found


def _take_plan(found: _Collected, message: Any) -> None:
    found.plans[message.plan_id] = (_stamp(message), message)


def _take_setpoint(found: _Collected, message: Any) -> None:
    of_plan = found.setpoints.setdefault(message.plan_id, Columns())
    of_plan.append(_stamp(message), message.differential_pressure)
    found.setpoint_indices.setdefault(message.plan_id, array("q")).append(int(message.index))


def _take_state(found: _Collected, message: Any) -> None:
    stamp, valid = _stamp(message), bool(message.valid)
    found.tip.append(stamp, (message.tip.x, message.tip.y) if valid else ())
    found.angles.append(stamp, message.bend_angle if valid else ())


def _take_truth(found: _Collected, message: Any) -> None:
    if message.valid:
        found.truth.append(_stamp(message), (message.tip.x, message.tip.y))


def _take_pressure(found: _Collected, message: Any) -> None:
    stamp = _stamp(message)
    found.commanded.append(stamp, message.commanded_differential)
    found.measured.append(stamp, message.measured_differential)
    if message.mode == FAULT_MODE:
        new = [(stamp, reason) for reason in message.faults or ["fault"]]
        found.faults += [entry for entry in new if len(found.faults) < MOST_FAULTS]


def _take_board(found: _Collected, message: Any) -> None:
    chambers = np.asarray(message.pressure)
    found.board.append(_stamp(message), chambers[0::2] - chambers[1::2])


@dataclass(frozen=True)
class _Setpoints:
    """Setpoints of one plan in the order of their indices, each once."""

    index: NDArray[np.int64]
    stamp: NDArray[np.int64]
    value: Array


def _setpoints(found: _Collected, plan_id: str, segment_count: int) -> _Setpoints:
    if plan_id not in found.setpoints:
        none = np.empty(0, dtype=np.int64)
        return _Setpoints(none, none, np.empty((0, segment_count)))
    rows = found.setpoints[plan_id]
    index, first = np.unique(np.array(found.setpoint_indices[plan_id]), return_index=True)
    return _Setpoints(index, rows.stamps()[first], rows.values(segment_count)[first])


def _series(found: _Collected, run: dict[str, Any], path: Path, plan_id: str) -> RunSeries:
    chosen = _choose_plan(found, path, plan_id)
    stamp, plan = found.plans[chosen]
    segment_count = int(plan.segment_count)
    setpoints = _setpoints(found, chosen, segment_count)
    times = np.array(plan.time)
    origin = _origin(stamp, times, setpoints)
    if origin == 0:
        raise EvaluationError(
            f"{path}: the plan '{chosen}' carries no stamp and none of its setpoints was recorded"
        )

    def stream(columns: Columns, width: int) -> Stream:
        """Return rows in the order of their stamps, each stamp once."""
        stamps, first = np.unique(columns.stamps(), return_index=True)
        return Stream((stamps - origin) / NANOSECONDS, columns.values(width)[first])

    end = times[-1]
    played = int(setpoints.index[-1]) if len(setpoints.index) else len(times) - 1
    faults = [text for when, text in found.faults if 0 <= (when - origin) / NANOSECONDS <= end]
    tip = stream(found.tip, 2)
    if not len(tip) or tip.time[-1] < 0 or tip.time[0] > end:
        raise EvaluationError(
            f"{path}: no limb state was recorded while the plan was played: did the tracker run?"
        )
    return RunSeries(
        description=_describe(plan, run, path),
        reference=Stream(times, np.array(plan.tip_reference).reshape(-1, 2)),
        predicted=Stream(times, np.array(plan.tip_predicted).reshape(-1, 2)),
        tip=tip,
        bend_angle=stream(found.angles, segment_count),
        commanded=stream(found.commanded, segment_count),
        measured=stream(found.measured, segment_count),
        truth=stream(found.truth, 2) if len(found.truth) else None,
        board=_board(found, setpoints, origin),
        faults=tuple(dict.fromkeys(faults)),
        finished=played == len(times) - 1 and tip.time[-1] >= end - 1.0,
        origin=origin,
    )


def _choose_plan(found: _Collected, path: Path, plan_id: str) -> str:
    usable = {name: entry for name, entry in found.plans.items() if len(entry[1].time) > 1}
    if not usable:
        raise EvaluationError(
            f"{path}: holds no {PLAN_TYPE}: was the recorder started before the planner planned?"
        )
    if plan_id:
        if plan_id not in usable:
            raise EvaluationError(f"{path}: no plan '{plan_id}', only {', '.join(sorted(usable))}")
        return plan_id
    return max(usable, key=lambda name: (len(found.setpoints.get(name, ())), usable[name][0]))


def _origin(stamp: int, times: Array, setpoints: _Setpoints) -> int:
    """Return the instant of the first setpoint [ns]: of the setpoints played, else of the plan."""
    usable = (setpoints.stamp > 0) & (setpoints.index < len(times))
    if not usable.any():
        return stamp
    planned = np.rint(times[setpoints.index[usable]] * NANOSECONDS).astype(np.int64)
    starts = np.sort(setpoints.stamp[usable] - planned)
    return int(starts[len(starts) // 2])  # a mean of int64 stamps would lose nanoseconds


def _board(found: _Collected, setpoints: _Setpoints, origin: int) -> BoardLog | None:
    if not len(found.board) or not len(setpoints.index):
        return None
    stamps = found.board.stamps()
    return BoardLog(
        setpoint_time=(setpoints.stamp - origin) / NANOSECONDS,
        setpoint=setpoints.value,
        command_time=(stamps - origin) / NANOSECONDS,
        command=found.board.values(setpoints.value.shape[1]),
    )


def _describe(plan: Any, run: dict[str, Any], path: Path) -> Description:
    known = {"motion", "model", "method", "trial", "seed", "limb"}
    return Description(
        motion=plan.motion or run.get("motion", ""),
        model=plan.model or run.get("model", ""),
        method=plan.method or run.get("method", ""),
        trial=int(run.get("trial", -1)),
        seed=int(run.get("seed", -1)),
        amplitude=float(plan.amplitude),
        period=float(plan.period),
        cycles=int(plan.cycles),
        limb=str(plan.limb or run.get("limb", "")),
        bag=str(path),
        extra={key: value for key, value in run.items() if key not in known},
    )
