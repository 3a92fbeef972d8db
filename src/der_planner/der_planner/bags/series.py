"""The only way from a bag to arrays: one limb's run, times counted from its first setpoint.

`record` reads the bag; here one plan of one limb is chosen from it, and what was recorded while
that plan was played becomes a `RunSeries`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.bags.record import (
    NANOSECONDS,
    PLAN_TYPE,
    BagRecord,
    Columns,
    LimbRecord,
    Revisions,
    planned_commands,
    read_record,
)
from der_planner.bags.run import (
    BoardLog,
    Description,
    EvaluationError,
    RunSeries,
    Stream,
    as_stream,
    method_name,
)

_LONGEST = 0.5
"""Latencies above this are no latencies of a picture that was waited for [s]."""


def load_run(path: str | Path, *, plan_id: str = "", namespace: str = "") -> RunSeries:
    """Read one run from its bag.

    Args:
        path: bag folder or file.
        plan_id: which plan of the bag; the one with the most recorded setpoints if empty.
        namespace: of the limb, e.g. ``/limb``; needed only where limbs of several have plans.

    Raises:
        EvaluationError: the bag has no plan, or no limb state while it was played.
        BagError: the bag cannot be read, or several limbs have plans and none is named.
    """
    record = read_record(path)
    with_plan = [name for name in record.played if plan_id in record.limbs[name].usable_plans]
    return run_of(record, record.limb_named(namespace, with_plan or record.played), plan_id)


@dataclass(frozen=True)
class _Setpoints:
    """Setpoints of one plan in the order of their indices, each as it was revised last."""

    index: NDArray[np.int64]
    stamp: NDArray[np.int64]
    value: Array


def _setpoints(limb: LimbRecord, plan_id: str, segment_count: int) -> _Setpoints:
    rows = limb.setpoints[plan_id]
    values = rows.values(1 + segment_count)
    backward = np.flatnonzero(np.isfinite(values[:, 0]))[::-1]
    index, first = np.unique(values[backward, 0].astype(np.int64), return_index=True)
    last = backward[first]
    return _Setpoints(index, rows.stamps()[last], values[last, 1:])


def run_of(record: BagRecord, namespace: str, plan_id: str = "") -> RunSeries:
    """Return the run of one limb of a bag.

    Args:
        record: of the bag.
        namespace: of the limb, one of ``record.limbs``.
        plan_id: which plan; the one with the most recorded setpoints if empty.

    Raises:
        EvaluationError: this limb has no such plan, or no state while it was played.
    """
    limb = record.limbs.get(namespace, LimbRecord())
    where = f"{record.path}, {namespace}" if len(record.limbs) > 1 else str(record.path)
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
    commands, revisions = _commands(plan, setpoints), limb.revisions[chosen]
    feedback = {}
    if revisions.stamps:
        added = commands - planned_commands(plan)
        told = described(added, latencies(revisions, limb.seen()))
        feedback = {"feedback": {**told, "warnings": revisions.warnings}}
    end = times[-1]
    played = int(setpoints.index[-1]) if len(setpoints.index) else len(times) - 1
    faults = [text for when, text in limb.faults if 0 <= (when - origin) / NANOSECONDS <= end]
    tip = stream(limb.tip, 2, origin)
    if not len(tip) or tip.time[-1] < 0 or tip.time[0] > end:
        apart = [name for name, one in record.limbs.items() if len(one.tip) and not one.plans]
        raise EvaluationError(
            f"{where}: no limb state was recorded while the plan was played: see whether "
            "the tracker ran, and the camera's stamps are of the planner's clock"
            + "".join(f"; states in {name}, where no plan is: remap them" for name in apart)
        )
    about = _describe(plan, record, namespace, feedback)
    # Planners of other people need not predict anything.
    foreseen = getattr(plan, "tip_predicted", ())
    predicted = np.array(foreseen).reshape(-1, 2) if len(foreseen) else None
    wanted = np.array(plan.tip_reference).reshape(-1, 2)
    return RunSeries(
        description=about,
        reference=as_stream(about, "tip_reference", times, wanted, 2),
        predicted=as_stream(about, "tip_predicted", times, predicted, 2),
        tip=tip,
        bend_angle=stream(limb.angles, segment_count, origin),
        tip_covariance=stream(limb.covariance, 4, origin),
        setpoints=Stream(times, commands),
        commanded=stream(limb.commanded, segment_count, origin),
        measured=stream(limb.measured, segment_count, origin),
        truth=stream(limb.truth, 2, origin) if len(limb.truth) else None,
        board=_board(limb, setpoints, origin, record.run.get("wiring")),
        faults=tuple(dict.fromkeys(faults)),
        touches=tuple(
            f"from {(since - origin) / NANOSECONDS:.2f} s on, {said}"
            for (name, since), (_, said) in limb.touches.items()
            if name == chosen
        ),
        finished=played == len(times) - 1 and tip.time[-1] >= end - 1.0,
        origin=origin,
        ahead=limb.ahead / NANOSECONDS,
    )


def _commands(plan: Any, setpoints: _Setpoints) -> Array:
    """Return the commands (K, M) [Pa] as they were sent; as planned where none was recorded."""
    command = planned_commands(plan)
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


def _choose_plan(limb: LimbRecord, where: str, plan_id: str) -> str:
    usable = limb.usable_plans
    if not usable:
        raise EvaluationError(
            f"{where}: holds no {PLAN_TYPE}: was the recorder started before the planner planned?"
        )
    if plan_id and plan_id not in usable:
        raise EvaluationError(f"{where}: no plan '{plan_id}', only {', '.join(sorted(usable))}")
    return plan_id or max(usable, key=lambda name: (len(limb.setpoints[name]), usable[name][0]))


def _origin(stamp: int, times: Array, setpoints: _Setpoints) -> int:
    """Return the instant of the first setpoint [ns]: of the setpoints played, else of the plan."""
    usable = (setpoints.stamp > 0) & (setpoints.index < len(times))
    if not usable.any():
        return stamp
    planned = np.rint(times[setpoints.index[usable]] * NANOSECONDS).astype(np.int64)
    starts = np.sort(setpoints.stamp[usable] - planned)
    return int(starts[len(starts) // 2])  # a mean of int64 stamps would lose nanoseconds


def _board(
    limb: LimbRecord, setpoints: _Setpoints, origin: int, valves: list[int] | None
) -> BoardLog | None:
    """Return what the board received; ``valves`` are those of the chambers, None: their own."""
    if not len(limb.board) or not len(setpoints.index):
        return None
    stamps, count = limb.board.stamps(), 2 * setpoints.value.shape[1]
    chambers = limb.board.values(count)[:, valves or range(count)]
    return BoardLog(
        setpoint_time=(setpoints.stamp - origin) / NANOSECONDS,
        setpoint=setpoints.value,
        command_time=(stamps - origin) / NANOSECONDS,
        command=chambers[:, 0::2] - chambers[:, 1::2],
    )


def _describe(
    plan: Any, record: BagRecord, namespace: str, feedback: dict[str, Any]
) -> Description:
    known = {"motion", "model", "method", "trial", "seed", "limb"}
    run = record.run
    # A plan along a path is named "path"; the recorder was told which one.
    drawn = plan.motion in ("", "path")
    x, y, z = getattr(plan, "gravity", (0.0, 0.0, 0.0))
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
        # Bags of older plans name no loads.
        gravity=(float(x), float(y), float(z)),
        payload=float(getattr(plan, "payload", 0.0)),
        payload_at=float(getattr(plan, "payload_at", 0.0)),
        extra={**{key: value for key, value in run.items() if key not in known}, **feedback},
    )


def latencies(revisions: Revisions, pictures: NDArray[np.int64]) -> Array:
    """Return the times (n,) [s] from pictures to the first setpoints that know of them.

    A setpoint goes to the board at its stamp. Pictures that no later revision knows of are left
    out, as are those between which feedback was out.

    Args:
        revisions: of the plan.
        pictures: (K,) stamps of the pictures on which the limb was seen [ns].
    """
    known = [
        (picture, stamp)
        for stamp, picture in zip(revisions.stamps, revisions.pictures, strict=True)
        if picture is not None
    ]
    if not known:
        return np.empty(0)
    newest, stamp = np.array(known, dtype=np.int64).T
    order = np.argsort(newest, kind="stable")
    newest, stamp = newest[order], stamp[order]
    # The first setpoint among those that know of this picture or of a later one.
    first = np.minimum.accumulate(stamp[::-1])[::-1]
    inside = np.unique(pictures[(pictures >= newest[0]) & (pictures <= newest[-1])])
    taken: Array = (first[np.searchsorted(newest, inside)] - inside) * 1e-9
    return taken[(taken > 0) & (taken < _LONGEST)]


def described(added: Array, taken: Array) -> dict[str, Any]:
    """Return what feedback did, in numbers to be kept with a run.

    Args:
        added: (K, M) the setpoints that were played less the plan's [Pa].
        taken: (n,) from pictures to the setpoints that know of them [s].
    """
    about: dict[str, Any] = {
        "correction_rms_pa": np.sqrt(np.mean(added**2, axis=0)).tolist(),
        "correction_max_pa": np.abs(added).max(axis=0).tolist(),
    }
    if len(taken):
        median, late = np.quantile(taken, [0.5, 0.99])
        about |= {"latency_median_s": float(median), "latency_p99_s": float(late)}
    return about
