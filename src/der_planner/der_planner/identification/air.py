"""From commanded to measured pressure: lags, dead time, venting, fill rate, offset."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from der_planner.identification.logs.log import CalibrationLog, LogError
from der_planner.limb import Limb, Pneumatics
from der_planner.model.air import Air

Array = NDArray[np.float64]

SMOOTH_RATE = 6000.0
"""Commands that rise faster than this [Pa/s] are steps: their flow is choked, not a lag."""
STEP_MEMORY = 3.0
"""Time after such a step that nothing is fitted to [s]."""
SHOWN = (0.25, 0.15)
"""Standard deviations up to which a log is said to show how fast chambers are vented: of the rate,
relative, and of the exponent."""
BETTER = 0.7
"""Share of the residual of lags alone that slow venting may leave to be believed."""
VALVE_BETTER = 0.85
"""Share of the residual of one lag that a lag which changes with the pressure may leave."""
_LAGS, _VENTING = 3, 5
"""How many of the numbers below are fitted with lags alone, and with slow venting."""
_LOWEST = (0.005, 0.005, 0.0, 300.0, 0.3, 0.0)
_HIGHEST = (1.5, 1.5, 1.9, 60e3, 1.0, 1.0)
_NAMES = (
    "time_constant",
    "vent_time_constant",
    "delay",
    "vent_rate",
    "vent_exponent",
    "vent_lag_exponent",
)
_START = (0.2, 0.2, 0.05, 5000.0, 0.7, 0.5)
_STEP = (2e-3, 2e-3, 2e-3, 20.0, 2e-3, 2e-3)
_SCALE = (0.1, 0.1, 0.1, 1000.0, 0.1, 0.1)


@dataclass(frozen=True)
class AirFit:
    """How chambers follow commands.

    Attributes:
        fill_lag, vent_lag: first-order time constants while |pressure| rises and falls [s].
        delay: dead time [s].
        fill_rate: largest rate of a filling chamber [Pa/s]; NaN without a step.
        offset: (M,) measured less commanded pressure at rest [Pa].
        residual: root mean square of measured less predicted along smooth commands and, where
            venting is shown, after steps down [Pa].
        uncertainty: (3,) standard deviations of the two lags and the dead time [s].
        vent_rate: rate at which a chamber at 10 kPa falls at the most [Pa/s]; NaN where the log
            does not show it.
        vent_exponent: its growth with the pressure [-]; NaN where the log does not show it.
        vent_uncertainty: (2,) standard deviations of the two.
        vent_lag_exponent: with which power of the pressure `vent_lag`, which is that at 10 kPa,
            falls [-]; 0 where one lag explains the log as well.
    """

    fill_lag: float
    vent_lag: float
    delay: float
    fill_rate: float
    offset: Array
    residual: float
    uncertainty: Array
    vent_rate: float = float("nan")
    vent_exponent: float = float("nan")
    vent_uncertainty: Array = field(default_factory=lambda: np.full(2, np.nan))
    vent_lag_exponent: float = 0.0


def fit_air(log: CalibrationLog, period: float) -> AirFit:
    """Fit the chambers' lag and venting to a log on a regular grid of ``period`` [s].

    The law is that of `der_planner.model.air`. A log whose chambers always follow their
    commands shows the lag alone; venting is then left open.

    Raises:
        LogError: the commands hold no smooth motion, or pressures were not measured.
    """
    command, measured = log.commanded_differential, log.measured_differential
    vented = np.all(np.abs(command[: max(2, round(1.0 / period))]) < 1.0, axis=1)
    rest = measured[: vented.size][vented]
    offset = np.nanmean(rest, axis=0) if len(rest) else np.zeros(command.shape[1])
    offset = np.nan_to_num(offset)
    known = np.isfinite(measured) & (np.abs(measured - offset) > 0.0)
    smooth = known & _after_no_step(command, period)
    moving = np.abs(np.gradient(command, period, axis=0)) > 200.0
    if np.count_nonzero(smooth & moving) < 3.0 / period:
        raise LogError(
            "the commands hold less than 3 s of smooth motion: the chambers' lag cannot be told; "
            "record the calibration run, or a plan"
        )
    falling = known & _after_no_step(np.abs(command), period, rising=True)
    found = _solve(command, measured - offset, falling, period, _START[:_VENTING])
    lags = _solve(command, measured - offset, smooth, period, _START[:_LAGS])
    without = (Air(_air(lags.x)).pressures_at_commands(command, period) + offset - measured)[
        falling
    ]
    venting = _shown(found) and found.spread < BETTER * float(np.sqrt(np.mean(without**2)))
    found = found if venting else lags
    valve = None
    if venting:
        start = (*found.x, _START[-1])
        valve = _solve(command, measured - offset, falling, period, start)
        valve = valve if _shown(valve) and valve.spread < VALVE_BETTER * found.spread else None
    found = valve or found
    return AirFit(
        fill_lag=float(found.x[0]),
        vent_lag=float(found.x[1]),
        delay=float(found.x[2]),
        fill_rate=_fill_rate(command, measured, period),
        offset=offset,
        residual=found.spread,
        uncertainty=found.deviation[:3],
        vent_rate=float(found.x[3]) if venting else float("nan"),
        vent_exponent=float(found.x[4]) if venting else float("nan"),
        vent_uncertainty=found.deviation[_LAGS:_VENTING] if venting else np.full(2, np.nan),
        vent_lag_exponent=float(valve.x[-1]) if valve else 0.0,
    )


@dataclass(frozen=True)
class _Solution:
    x: Array
    deviation: Array
    spread: float


def _solve(
    command: Array,
    measured: Array,
    rows: NDArray[np.bool_],
    period: float,
    start: tuple[float, ...],
) -> _Solution:
    """Fit as many of the numbers `_NAMES` as ``start`` has to rows of a log."""
    count = len(start)

    def residual(x: Array) -> Array:
        difference: Array = (Air(_air(x)).pressures_at_commands(command, period) - measured)[rows]
        return difference

    def jacobian(x: Array) -> Array:
        # Steps of their own size: a dead time of nearly zero would get none from a relative one.
        ahead = x + np.asarray(_STEP[:count]) <= np.asarray(_HIGHEST[:count])
        steps = np.where(ahead, 1.0, -1.0) * _STEP[:count]
        base = residual(x)
        moved = [residual(x + step) for step in np.diag(steps)]
        slopes: Array = (np.stack(moved, axis=1) - base[:, None]) / steps
        return slopes

    solution = least_squares(
        residual,
        start,
        jac=jacobian,
        bounds=(_LOWEST[:count], _HIGHEST[:count]),
        loss="soft_l1",
        f_scale=50.0,
        x_scale=_SCALE[:count],
    )
    spread = float(np.sqrt(np.mean(residual(solution.x) ** 2)))
    scale = np.asarray(_SCALE[:count])
    # In units of their own: the pseudo-inverse would take seconds beside pascals for nothing.
    slopes = jacobian(solution.x) * scale
    covariance = np.linalg.pinv(slopes.T @ slopes, hermitian=True) * spread**2 / period
    return _Solution(np.asarray(solution.x), np.sqrt(np.diag(covariance)) * scale, spread)


def _air(x: Array) -> Pneumatics:
    """Return the law for the numbers `_NAMES`, as many as there are."""
    values = dict(zip(_NAMES, (float(value) for value in x), strict=False))
    return replace(Limb.default().pneumatics, **{"vent_rate": 0.0, **values})


def _shown(solution: _Solution) -> bool:
    """Tell whether rate and exponent of venting are known well, the rate inside its bounds."""
    rate, of_rate, of_exponent = solution.x[_LAGS], *solution.deviation[_LAGS:_VENTING]
    known = 0.0 < of_rate < SHOWN[0] * rate and 0.0 < of_exponent < SHOWN[1]
    return bool(known and _LOWEST[3] < 0.9 * rate < 0.8 * _HIGHEST[3])


def _after_no_step(command: Array, period: float, rising: bool = False) -> NDArray[np.bool_]:
    """Tell rows (K, M) with no step just before them; ``rising`` counts only steps up."""
    change = np.diff(command, axis=0, prepend=command[:1])
    jump = (change if rising else np.abs(change)) > SMOOTH_RATE * period
    count = round(STEP_MEMORY / period)
    recent = np.cumsum(jump, axis=0)
    before = np.concatenate([np.zeros((count, command.shape[1])), recent])[: len(recent)]
    smooth: NDArray[np.bool_] = (recent - before) < 0.5
    return smooth


def _fill_rate(command: Array, measured: Array, period: float) -> float:
    jump = np.abs(np.diff(command, axis=0, prepend=command[:1])) > 3000.0
    if not jump.any():
        return float("nan")
    span = max(2, round(0.3 / period))
    rate = np.abs(measured[span:] - measured[:-span]) / (span * period)
    rate = rate[np.isfinite(rate) & (np.abs(measured[span:]) > np.abs(measured[:-span]))]
    return float(np.quantile(rate, 0.995)) if rate.size else float("nan")
