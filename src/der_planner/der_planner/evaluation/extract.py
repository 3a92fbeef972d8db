"""From a bag to a `RunSeries`: topics found by type, times by stamps, nothing guessed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from der_planner.evaluation.series import (
    Array,
    BoardLog,
    Description,
    EvaluationError,
    RunSeries,
    Stream,
)
from der_planner.recording.reader import BagError, BagReader

NANOSECONDS = 1_000_000_000
PLAN_TYPE = "der_msgs/msg/PressurePlan"
SETPOINT_TYPE = "der_msgs/msg/PressureSetpoint"
PRESSURE_TYPE = "der_msgs/msg/PressureState"
STATE_TYPE = "der_msgs/msg/LimbState"
CHAMBERS_TYPE = "der_msgs/msg/ChamberPressures"
TRUTH_SUFFIX = "twin/ground_truth"
BOARD_SUFFIX = "twin/board_commands"
FAULT_MODE = 5


@dataclass
class _Collected:
    """Plain numbers of the messages of interest; stamps as integer ns."""

    plans: dict[str, tuple[int, Any]] = field(default_factory=dict)
    setpoints: dict[str, dict[int, tuple[int, Array]]] = field(default_factory=dict)
    tip: list[tuple[int, float, float, Array]] = field(default_factory=list)
    truth: list[tuple[int, float, float]] = field(default_factory=list)
    pressure: list[tuple[int, Array, Array]] = field(default_factory=list)
    faults: list[tuple[int, str]] = field(default_factory=list)
    board: list[tuple[int, Array]] = field(default_factory=list)


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
    of_plan = found.setpoints.setdefault(message.plan_id, {})
    of_plan[int(message.index)] = (_stamp(message), np.array(message.differential_pressure))


def _take_state(found: _Collected, message: Any) -> None:
    valid = bool(message.valid)
    x, y = (message.tip.x, message.tip.y) if valid else (np.nan, np.nan)
    angles = np.array(message.bend_angle) if valid else np.empty(0)
    found.tip.append((_stamp(message), x, y, angles))


def _take_truth(found: _Collected, message: Any) -> None:
    if message.valid:
        found.truth.append((_stamp(message), message.tip.x, message.tip.y))


def _take_pressure(found: _Collected, message: Any) -> None:
    stamp = _stamp(message)
    found.pressure.append(
        (
            stamp,
            np.array(message.commanded_differential),
            np.array(message.measured_differential),
        )
    )
    if message.mode == FAULT_MODE:
        found.faults += [(stamp, reason) for reason in message.faults or ["fault"]]


def _take_board(found: _Collected, message: Any) -> None:
    chambers = np.array(message.pressure)
    found.board.append((_stamp(message), chambers[0::2] - chambers[1::2]))


def _series(found: _Collected, run: dict[str, Any], path: Path, plan_id: str) -> RunSeries:
    chosen = _choose_plan(found, path, plan_id)
    stamp, plan = found.plans[chosen]
    setpoints = found.setpoints.get(chosen, {})
    times = np.array(plan.time)
    origin = _origin(stamp, times, setpoints)
    if origin == 0:
        raise EvaluationError(
            f"{path}: the plan '{chosen}' carries no stamp and none of its setpoints was recorded"
        )
    played = max(setpoints, default=len(times) - 1)
    segment_count = int(plan.segment_count)
    ticks = np.array([(entry[0] - origin) / NANOSECONDS for entry in found.pressure])
    commanded = _matrix([entry[1] for entry in found.pressure], segment_count)
    measured = _matrix([entry[2] for entry in found.pressure], segment_count)
    end = times[-1]
    faults = [text for when, text in found.faults if 0 <= (when - origin) / NANOSECONDS <= end]
    frames, positions, angles = _frames(found, origin, segment_count)
    if not len(frames) or frames[-1] < 0 or frames[0] > end:
        raise EvaluationError(
            f"{path}: no limb state was recorded while the plan was played: did the tracker run?"
        )
    return RunSeries(
        description=_describe(plan, run, path),
        reference=Stream(times, np.array(plan.tip_reference).reshape(-1, 2)),
        predicted=Stream(times, np.array(plan.tip_predicted).reshape(-1, 2)),
        tip=Stream(frames, positions),
        bend_angle=Stream(frames, angles),
        commanded=Stream(ticks, commanded),
        measured=Stream(ticks, measured),
        truth=_truth(found, origin),
        board=_board(found, setpoints, origin),
        faults=tuple(dict.fromkeys(faults)),
        finished=played == len(times) - 1 and frames[-1] >= end - 1.0,
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
    return max(usable, key=lambda name: (len(found.setpoints.get(name, {})), usable[name][0]))


def _origin(stamp: int, times: Array, setpoints: dict[int, tuple[int, Array]]) -> int:
    """Return the instant of the first setpoint [ns]: of the setpoints played, else of the plan."""
    starts = [
        when - round(times[index] * NANOSECONDS)
        for index, (when, _) in setpoints.items()
        if when and index < len(times)
    ]
    return int(np.median(np.array(starts, dtype=np.int64))) if starts else stamp


def _frames(found: _Collected, origin: int, segment_count: int) -> tuple[Array, Array, Array]:
    """Return times, tips and bend angles in the order of the stamps, each stamp once."""
    unique = {entry[0]: entry for entry in found.tip}
    ordered = [unique[stamp] for stamp in sorted(unique)]
    times = np.array([(entry[0] - origin) / NANOSECONDS for entry in ordered])
    tips = np.array([entry[1:3] for entry in ordered]).reshape(-1, 2)
    return times, tips, _matrix([entry[3] for entry in ordered], segment_count)


def _matrix(rows: list[Array], columns: int) -> Array:
    """Stack rows; NaN where a row has another length (not yet measured)."""
    result = np.full((len(rows), columns), np.nan)
    for index, row in enumerate(rows):
        if len(row) == columns:
            result[index] = row
    return result


def _truth(found: _Collected, origin: int) -> Stream | None:
    if not found.truth:
        return None
    data = sorted(set(found.truth))
    time = np.array([(entry[0] - origin) / NANOSECONDS for entry in data])
    return Stream(time, np.array([entry[1:] for entry in data]))


def _board(
    found: _Collected, setpoints: dict[int, tuple[int, Array]], origin: int
) -> BoardLog | None:
    if not found.board or not setpoints:
        return None
    ordered = [setpoints[index] for index in sorted(setpoints)]
    return BoardLog(
        setpoint_time=np.array([(stamp - origin) / NANOSECONDS for stamp, _ in ordered]),
        setpoint=np.array([value for _, value in ordered]),
        command_time=np.array([(stamp - origin) / NANOSECONDS for stamp, _ in found.board]),
        command=np.array([value for _, value in found.board]),
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
