"""From commanded to measured pressure: lags, dead time, venting, fill rate, offset."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from der_planner.arrays import Array
from der_planner.identification.least_squares import (
    LeastSquares,
    Rows,
    Unknowns,
    with_differences,
)
from der_planner.identification.log import CalibrationLog, LogError
from der_planner.limb import Limb, Pneumatics
from der_planner.model import CONTROL_PERIOD as PERIOD
from der_planner.model.air import Air

SMOOTH_RATE = 0.25
"""Rate from which on a change of a command is a step, over the pressure limit [1/s]: its flow is
choked, not a lag."""
STEP = 0.125
"""Change of a command in a control period that shows the fill rate, over the pressure limit."""
MOVES = 0.0083
"""Rate from which on a command shows the lag, over the pressure limit [1/s]."""
STEP_MEMORY = 3.0
"""Time after such a step that nothing is fitted to [s]."""
SHOWN = {"vent_rate": 0.25, "vent_exponent": 0.15}
"""Standard deviations up to which a log is said to show how fast chambers are vented: of the rate,
relative, and of the exponent."""
BETTER = 0.7
"""Share of the residual of lags alone that slow venting may leave to be believed."""
VALVE_BETTER = 0.85
"""Share of the residual of one lag that a lag which changes with the pressure may leave."""
_NUDGE = 0.02
"""Change of a number for a slope, in its scale."""
SOFTNESS = 0.0021
"""Errors beyond this share of the pressure limit count less than their square."""

_NUMBERS = {
    "time_constant": (0.2, 0.005, 1.5, 0.1),
    "vent_time_constant": (0.2, 0.005, 1.5, 0.1),
    "delay": (0.05, 0.0, 1.9, 0.1),
    "vent_rate": (5000.0, 300.0, 60e3, 1000.0),
    "vent_exponent": (0.7, 0.3, 1.0, 0.1),
    "vent_lag_exponent": (0.5, 0.0, 1.0, 0.1),
}
"""Numbers of `Pneumatics` that are fitted: start, least and largest value, scale. Lags are
the first three, slow venting adds two, a valve that opens in proportion to its error the last."""
_LAGS, _VENTING, _VALVE = (tuple(_NUMBERS)[:count] for count in (3, 5, 6))


@dataclass(frozen=True)
class AirFit:
    """How chambers follow commands.

    Attributes:
        numbers: of `Pneumatics` by name; without those of venting where the log does not show it.
        deviations: standard deviations of the numbers that were fitted, by name.
        residual: root mean square of measured less predicted along smooth commands and, where
            venting is shown, after steps down [Pa].
        fill_rate: largest rate of a filling chamber [Pa/s]; NaN without a step.
        offset: (M,) measured less commanded pressure at rest [Pa].
    """

    numbers: Mapping[str, float]
    deviations: Mapping[str, float]
    residual: float
    fill_rate: float = math.nan
    offset: Array | float = 0.0

    def law(self, prior: Pneumatics) -> Pneumatics:
        """Return a law of the air with the fitted numbers in place of the prior's."""
        return replace(prior, **self.numbers)


def fit_air(log: CalibrationLog, prior: Pneumatics) -> AirFit:
    """Fit the chambers' lag and venting to a log on the grid of the control period.

    The law is that of `der_planner.model.air`. A log whose chambers always follow their
    commands shows the lag alone; venting is then left open. The prior says what a limb's pressures
    are like.

    Raises:
        LogError: the commands hold no smooth motion, or pressures were not measured.
    """
    command, measured = log.commanded_differential, log.measured_differential
    vented = np.all(np.abs(command[: max(2, round(1.0 / PERIOD))]) < 1.0, axis=1)
    rest = measured[: vented.size][vented]
    offset = np.nanmean(rest, axis=0) if len(rest) else np.zeros(command.shape[1])
    offset = np.nan_to_num(offset)
    if np.nanstd(measured - command) < 1e-6 * prior.pressure_limit:
        raise LogError(
            "the commands are the chambers' pressures themselves, and tell nothing of their lag"
        )
    known = np.isfinite(measured) & (np.abs(measured - offset) > 0.0)
    limit = prior.pressure_limit
    smooth = known & _after_no_step(command, SMOOTH_RATE * limit)
    moving = np.abs(np.gradient(command, PERIOD, axis=0)) > MOVES * limit
    if np.count_nonzero(smooth & moving) < 3.0 / PERIOD:
        raise LogError(
            "the commands hold less than 3 s of smooth motion: the chambers' lag cannot be told; "
            "record the calibration run, or a plan"
        )
    falling = known & _after_no_step(np.abs(command), SMOOTH_RATE * limit, rising=True)
    lags = _Chambers(command, measured - offset, smooth, SOFTNESS * limit)
    venting = replace(lags, rows=falling)
    found, slow = lags.fit(_LAGS), venting.fit(_VENTING)
    alone = float(np.sqrt(np.mean(venting.residual(found.numbers) ** 2)))
    if _shown(slow) and slow.residual < BETTER * alone:
        valve = venting.fit(_VALVE, slow.numbers)
        by_degrees = _shown(valve) and valve.residual < VALVE_BETTER * slow.residual
        found = valve if by_degrees else slow
        found = replace(found, numbers={"vent_lag_exponent": 0.0, **found.numbers})
    return replace(found, fill_rate=_fill_rate(command, measured, STEP * limit), offset=offset)


@dataclass(frozen=True)
class _Chambers:
    """Commands and measured pressures (K, M) [Pa], and rows (K, M) to fit to.

    Errors beyond ``softness`` count less than their square [Pa].
    """

    command: Array
    measured: Array
    rows: NDArray[np.bool_]
    softness: float

    def residual(self, numbers: Mapping[str, float]) -> Array:
        """Return predicted less measured pressures of the rows [Pa]."""
        law = replace(Limb.default().pneumatics, **{"vent_rate": 0.0, **numbers})
        predicted = Air(law).pressures_at_commands(self.command, PERIOD)
        return np.asarray((predicted - self.measured)[self.rows])

    def fit(self, names: tuple[str, ...], start: Mapping[str, float] | None = None) -> AirFit:
        """Fit the numbers of these names, from other starts where they are given."""
        begin, low, high, scale = np.array([_NUMBERS[name] for name in names]).T
        begin = np.array([(start or {}).get(n, v) for n, v in zip(names, begin, strict=True)])

        def of(values: Array) -> dict[str, float]:
            return dict(zip(names, map(float, values), strict=True))

        def rows(values: Array) -> Rows:
            # Of a size of their own: a relative change of a dead time near zero would be none.
            steps = np.where(values + _NUDGE * scale <= high, _NUDGE * scale, -_NUDGE * scale)
            return with_differences(lambda v: self.residual(of(v)) / self.softness, values, steps)

        nothing = np.full(len(names), np.inf)
        search = LeastSquares(
            Unknowns(begin, nothing, low, high, scale), rows, softness=1.0, cheap=True
        )
        values = search.solve()
        left = float(np.sqrt(np.mean(self.residual(of(values)) ** 2)))
        covariance = search.covariance(values, (left / self.softness) ** 2 / PERIOD)
        return AirFit(of(values), of(np.sqrt(np.diag(covariance))), left)


def _shown(found: AirFit) -> bool:
    """Tell whether rate and exponent of venting are known well, the rate inside its bounds."""
    rate, (_, low, high, _) = found.numbers["vent_rate"], _NUMBERS["vent_rate"]
    of_rate, of_exponent = (found.deviations[name] for name in SHOWN)
    known = 0.0 < of_rate < SHOWN["vent_rate"] * rate and 0.0 < of_exponent < SHOWN["vent_exponent"]
    return known and low < 0.9 * rate < 0.8 * high


def _after_no_step(command: Array, rate: float, rising: bool = False) -> NDArray[np.bool_]:
    """Tell rows (K, M) with no step just before them, one faster than a rate [Pa/s].

    ``rising`` counts only steps up.
    """
    change = np.diff(command, axis=0, prepend=command[:1])
    jump = ~((change if rising else np.abs(change)) <= rate * PERIOD)
    memory = np.ones(round(STEP_MEMORY / PERIOD))
    return np.asarray(lfilter(memory, [1.0], jump.astype(float), axis=0) < 0.5)


def _fill_rate(command: Array, measured: Array, step: float) -> float:
    jump = np.abs(np.diff(command, axis=0, prepend=command[:1])) > step
    if not jump.any():
        return float("nan")
    span = max(2, round(0.3 / PERIOD))
    rate = np.abs(measured[span:] - measured[:-span]) / (span * PERIOD)
    rate = rate[np.isfinite(rate) & (np.abs(measured[span:]) > np.abs(measured[:-span]))]
    return float(np.quantile(rate, 0.995)) if rate.size else float("nan")
