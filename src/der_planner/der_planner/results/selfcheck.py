"""Checks of the instruments themselves, where a bag of the twin allows them.

The tracker's tip against the simulated one, and the board's log of commands against the setpoints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from der_planner.bags.run import Array, BoardLog, Stream

ROUNDING = 160.0
"""Largest difference [Pa] of a setpoint and its command: both chambers are rounded to 1 hPa."""
ON_TIME = 0.025
"""Half the period of the setpoints [s]: a command nearer than that belongs to the setpoint."""
LATEST = 0.5
"""A setpoint that reached the board later than this [s] is lost."""


@dataclass(frozen=True)
class TrackerCheck:
    """Distance of the tracked from the simulated tip [m]."""

    rms: float
    maximum: float
    samples: int


@dataclass(frozen=True)
class BoardCheck:
    """What the board received.

    Attributes:
        setpoints: sent.
        received: found among the board's commands.
        lost: not found within `LATEST`.
        out_of_order: received before an earlier one.
        lateness_p50, lateness_p99, lateness_max: arrival after the stamp [s]; NaN without any.
        value_error: largest difference of the values [Pa]; rounding of the wire is up to 100.
    """

    setpoints: int
    received: int
    lost: int
    out_of_order: int
    lateness_p50: float
    lateness_p99: float
    lateness_max: float
    value_error: float


def check_tracker(
    tip: Stream, truth: Stream | None, first: float, last: float
) -> TrackerCheck | None:
    """Compare tracked and simulated tip at the images' stamps between two times.

    Args:
        tip: (F, 2) tracked, NaN where invalid.
        truth: (T, 2) simulated.
        first: start of the window [s].
        last: its end [s].

    Returns:
        None where the bag has no ground truth in the window.
    """
    if truth is None or len(truth) < 2:
        return None
    inside = (
        (tip.time >= max(first, truth.time[0]))
        & (tip.time <= min(last, truth.time[-1]))
        & np.isfinite(tip.value).all(axis=1)
    )
    if not inside.any():
        return None
    simulated = interpolate(truth, tip.time[inside])
    distance = np.linalg.norm(tip.value[inside] - simulated, axis=1)
    return TrackerCheck(
        rms=float(np.sqrt(np.mean(distance**2))),
        maximum=float(distance.max()),
        samples=int(inside.sum()),
    )


def interpolate(stream: Stream, time: Array) -> Array:
    """Return the stream's columns at other times, linear between its samples."""
    columns = [np.interp(time, stream.time, column) for column in stream.value.T]
    return np.column_stack(columns)


def check_board(log: BoardLog | None) -> BoardCheck | None:
    """Match every setpoint with the command that carried it.

    The command nearest in time is the setpoint's own if its value is the setpoint's within the
    wire's rounding. A setpoint without such a command is looked for among the later ones that
    belong to no other setpoint, up to `LATEST` after its stamp.
    """
    if log is None or not len(log.setpoint_time):
        return None
    order = np.argsort(log.command_time, kind="stable")
    arrival = log.command_time[order]
    taken: set[int] = set()
    matched: dict[int, int] = {}

    def take(index: int, places: NDArray[np.int64]) -> None:
        for place in places:
            number = int(order[place])
            if number not in taken and _difference(log, index, number) <= ROUNDING:
                taken.add(number)
                matched[index] = number
                return

    for index, stamp in enumerate(log.setpoint_time):
        first, last = np.searchsorted(arrival, [stamp - ON_TIME, stamp + ON_TIME])
        near = np.arange(first, last)
        take(index, near[np.argsort(np.abs(arrival[near] - stamp))][:1])
    for index, stamp in enumerate(log.setpoint_time):
        if index not in matched:
            take(index, np.arange(*np.searchsorted(arrival, [stamp - ON_TIME, stamp + LATEST])))
    return _board_figures(log, matched)


def _difference(log: BoardLog, setpoint: int, command: int) -> float:
    return float(np.max(np.abs(log.setpoint[setpoint] - log.command[command])))


def _board_figures(log: BoardLog, matched: dict[int, int]) -> BoardCheck:
    order = [matched[index] for index in sorted(matched)]
    lateness = np.array(
        [log.command_time[place] - log.setpoint_time[index] for index, place in matched.items()]
    )
    quantiles = np.quantile(lateness, [0.5, 0.99]) if len(lateness) else [np.nan, np.nan]
    return BoardCheck(
        setpoints=len(log.setpoint_time),
        received=len(matched),
        lost=len(log.setpoint_time) - len(matched),
        out_of_order=int(np.sum(np.diff(order) < 0)),
        lateness_p50=float(quantiles[0]),
        lateness_p99=float(quantiles[1]),
        lateness_max=float(lateness.max()) if len(lateness) else float("nan"),
        value_error=max((_difference(log, i, p) for i, p in matched.items()), default=float("nan")),
    )
