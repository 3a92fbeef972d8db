"""Errors over time: of the tip, what explains them, and of the instruments themselves.

Measured and asked-for tip are compared at the same instants. Times come from stamps; nothing is
shifted. In a bag of the twin the tracker's tip is compared with the
simulated one, and the board's log of commands with the setpoints.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from der_planner.arrays import Array, rms_distance
from der_planner.bags.run import BoardLog, EvaluationError, RunSeries, Stream

LARGEST_LAG = 1.0
"""Bound of the estimated lag [s]."""
STANDSTILL = 1e-6
"""A reference that moves less [m] stands still."""
ROUNDING = 160.0
"""Largest difference [Pa] of a setpoint and its command: both chambers are rounded to 1 hPa."""
ON_TIME = 0.025
"""Half the period of the setpoints [s]: a command nearer than that belongs to the setpoint."""
LATEST = 0.5
"""A setpoint that reached the board later than this [s] is lost."""


@dataclass(frozen=True)
class Split:
    """The measured tip as a late, scaled and shifted copy of the reference, and what is left.

    r(t) ≈ g r̄(t − τ) + b per axis, fitted by least squares over the window; τ is common.

    Attributes:
        lag_s: τ [s], positive when the limb is late.
        gain_x, gain_y: g.
        bias_x_m, bias_y_m: mean of r − r̄ over the window after the lag is taken out [m].
        rms_without_lag_m: RMS of |r − r̄| [m] after the lag is taken out.
        rms_without_bias_m: after the mean is taken out, too.
        rms_without_gain_m: after the gains are fitted, too: neither lag, bias nor gain explains it.
    """

    lag_s: float
    gain_x: float
    gain_y: float
    bias_x_m: float
    bias_y_m: float
    rms_without_lag_m: float
    rms_without_bias_m: float
    rms_without_gain_m: float


def error_series(run: RunSeries) -> Stream:
    """Return the measured tip minus the reference (F, 2) [m] at every valid image of the window.

    Raises:
        EvaluationError: there is no valid image in the window.
    """
    tip = _seen(run, *window(run))
    return Stream(tip.time, tip.value - run.reference.at(tip.time))


def _seen(run: RunSeries, first: float, last: float) -> Stream:
    """Return the measured tip between two times.

    Raises:
        EvaluationError: it was never seen there.
    """
    found = run.tip.known.between(first, last)
    if not len(found):
        raise EvaluationError(
            f"{run.description.title}: no valid limb state between the first and the last setpoint"
        )
    return found


def window(run: RunSeries) -> tuple[float, float]:
    """Return the instants of the first and the last setpoint [s]."""
    return float(run.reference.time[0]), float(run.reference.time[-1])


def split_error(run: RunSeries) -> Split:
    """Fit lag, gain and bias of the measured against the reference tip.

    The lag minimises what gains and mean leave of the squared distance of r(t) and r̄(t − τ), |τ| up
    to 1 s and a tenth of the window; a reference that stands still has none, and gets 0.

    Args:
        run: with at least a few valid images.

    Raises:
        EvaluationError: there is no valid image in the window.
    """
    first, last = window(run)
    # The same samples for every lag, so that residuals compare.
    margin = min(LARGEST_LAG, 0.1 * (last - first))
    tip = run.tip.known.between(first + margin, last - margin)
    if len(tip) < 3:
        tip = _seen(run, first, last)
    time, measured = tip.time, tip.value
    lag = _best_lag(run.reference, time, measured, margin)
    late = run.reference.at(time - lag)
    offset = (measured - late).mean(axis=0)
    gains, fitted = _fit_gains(late, measured)
    return Split(
        lag_s=lag,
        gain_x=float(gains[0]),
        gain_y=float(gains[1]),
        bias_x_m=float(offset[0]),
        bias_y_m=float(offset[1]),
        rms_without_lag_m=rms_distance(measured - late),
        rms_without_bias_m=rms_distance(measured - late - offset),
        rms_without_gain_m=rms_distance(measured - fitted),
    )


def _best_lag(reference: Stream, time: Array, measured: Array, margin: float) -> float:
    def cost(lag: float) -> float:
        _, fitted = _fit_gains(reference.at(time - lag), measured)
        return rms_distance(measured - fitted)

    if np.ptp(reference.value, axis=0).max() < STANDSTILL:
        return 0.0
    grid = np.linspace(-margin, margin, 41)
    best = grid[int(np.argmin([cost(lag) for lag in grid]))]
    step = grid[1] - grid[0]
    found = minimize_scalar(
        cost,
        bounds=(max(-margin, best - step), min(margin, best + step)),
        method="bounded",
        options={"xatol": 1e-5},
    )
    return float(found.x)


def _fit_gains(reference: Array, measured: Array) -> tuple[Array, Array]:
    centred = reference - reference.mean(axis=0)
    power, shared = (centred**2).sum(axis=0), (centred * measured).sum(axis=0)
    # An axis along which the reference stands still has no gain.
    gains = np.divide(shared, power, out=np.ones(2), where=power > 1e-12 * len(centred))
    return gains, measured.mean(axis=0) + gains * centred


def check_tracker(tip: Stream, truth: Stream | None, first: float, last: float) -> dict[str, float]:
    """Compare tracked and simulated tip at the images' stamps between two times.

    Args:
        tip: (F, 2) tracked, NaN where invalid.
        truth: (T, 2) simulated.
        first: start of the window [s].
        last: its end [s].

    Returns:
        Their distance, ``tracker_rms_m`` and ``tracker_max_m``, and ``tracker_samples``; nothing
        where the bag has no ground truth in the window.
    """
    if truth is None or len(truth) < 2:
        return {}
    tip = tip.known.between(max(first, truth.time[0]), min(last, truth.time[-1]))
    if not len(tip):
        return {}
    apart = tip.value - truth.at(tip.time)
    return {
        "tracker_rms_m": rms_distance(apart),
        "tracker_max_m": float(np.linalg.norm(apart, axis=1).max()),
        "tracker_samples": len(tip),
    }


def check_board(log: BoardLog | None) -> dict[str, float]:
    """Match every setpoint with the command that carried it.

    The command nearest in time is the setpoint's own if its value is the setpoint's within the
    wire's rounding. A setpoint without such a command is looked for among the later ones that
    belong to no other setpoint, up to `LATEST` after its stamp.

    Returns:
        ``board_setpoints`` sent, ``board_received`` of them, ``board_lost`` (not found),
        ``board_out_of_order`` (received before an earlier one, where their values tell the two
        apart), ``board_lateness_…_s`` after the stamp (NaN without any), ``board_value_error_pa``
        (up to 100 is the wire's rounding); nothing where there is no log.
    """
    if log is None or not len(log.setpoint_time):
        return {}
    order = np.argsort(log.command_time, kind="stable")
    arrival = log.command_time[order]
    matched: dict[int, int] = {}
    taken: set[int] = set()

    def difference(setpoint: int, command: int) -> float:
        return float(np.max(np.abs(log.setpoint[setpoint] - log.command[command])))

    def match(setpoint: int, places: NDArray[np.int64]) -> None:
        for command in order[places]:
            if command not in taken and difference(setpoint, command) <= ROUNDING:
                taken.add(int(command))
                matched[setpoint] = int(command)
                return

    for index, stamp in enumerate(log.setpoint_time):
        near = np.arange(*np.searchsorted(arrival, [stamp - ON_TIME, stamp + ON_TIME]))
        match(index, near[np.argsort(np.abs(arrival[near] - stamp))][:1])
    for index, stamp in enumerate(log.setpoint_time):
        if index not in matched:
            match(index, np.arange(*np.searchsorted(arrival, [stamp - ON_TIME, stamp + LATEST])))
    late = np.array([log.command_time[c] - log.setpoint_time[s] for s, c in matched.items()])
    median, high = np.quantile(late, [0.5, 0.99]) if len(late) else (np.nan, np.nan)
    wrong = [difference(*pair) for pair in matched.items()]
    crossed = [
        first > second and max(difference(s, second), difference(t, first)) > ROUNDING
        for (s, first), (t, second) in itertools.pairwise(sorted(matched.items()))
    ]
    return {
        "board_setpoints": len(log.setpoint_time),
        "board_received": len(matched),
        "board_lost": len(log.setpoint_time) - len(matched),
        "board_out_of_order": sum(crossed),
        "board_lateness_p50_s": float(median),
        "board_lateness_p99_s": float(high),
        "board_lateness_max_s": float(late.max()) if len(late) else float("nan"),
        "board_value_error_pa": max(wrong, default=np.nan),
    }
