"""From commanded to measured pressure: lags, dead time, fill rate, offset."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from der_planner.identification.log import CalibrationLog, LogError
from der_planner.limb import Limb
from der_planner.planning.pneumatics import chamber_pressures

Array = NDArray[np.float64]

SMOOTH_RATE = 6000.0
"""Commands that change faster than this [Pa/s] are steps: their flow is choked, not a lag."""
STEP_MEMORY = 3.0
"""Time after a step that the lag is not fitted to [s]."""
_LOWEST = (0.005, 0.005, 0.0)
_HIGHEST = (1.5, 1.5, 1.9)


@dataclass(frozen=True)
class AirFit:
    """How chambers follow commands.

    Attributes:
        fill_lag, vent_lag: first-order time constants while |pressure| rises and falls [s].
        delay: dead time [s].
        fill_rate: largest rate of a filling chamber [Pa/s]; NaN without a step.
        offset: (M,) measured less commanded pressure at rest [Pa].
        residual: root mean square of measured less predicted along smooth commands [Pa].
        uncertainty: (3,) standard deviations of the two lags and the dead time [s].
    """

    fill_lag: float
    vent_lag: float
    delay: float
    fill_rate: float
    offset: Array
    residual: float
    uncertainty: Array


def fit_air(log: CalibrationLog, period: float) -> AirFit:
    """Fit the chambers' lag to a log on a regular grid of ``period`` [s].

    Raises:
        LogError: the commands hold no smooth motion, or pressures were not measured.
    """
    command, measured = log.commanded_differential, log.measured_differential
    vented = np.all(np.abs(command[: max(2, round(1.0 / period))]) < 1.0, axis=1)
    rest = measured[: vented.size][vented]
    offset = np.nanmean(rest, axis=0) if len(rest) else np.zeros(command.shape[1])
    offset = np.nan_to_num(offset)
    rows = _smooth_rows(command, period) & np.isfinite(measured)
    rows &= np.abs(measured - offset) > 0.0
    moving = np.abs(np.gradient(command, period, axis=0)) > 200.0
    if np.count_nonzero(rows & moving) < 3.0 / period:
        raise LogError(
            "the commands hold less than 3 s of smooth motion: the chambers' lag cannot be told; "
            "record the calibration run, or a plan"
        )

    def residual(x: Array) -> Array:
        air = replace(
            Limb.default().pneumatics,
            time_constant=x[0],
            vent_time_constant=x[1],
            delay=x[2],
        )
        middle = chamber_pressures(air, command, period, 2)[:, 0]
        # The middle of the first half period is a quarter of a period after the instant.
        instants = np.arange(len(command)) * period
        predicted = np.stack(
            [np.interp(instants, instants + 0.25 * period, column) for column in middle.T], axis=1
        )
        difference: Array = (predicted + offset - measured)[rows]
        return difference

    solution = least_squares(
        residual,
        (0.2, 0.2, 0.05),
        bounds=(_LOWEST, _HIGHEST),
        loss="soft_l1",
        f_scale=50.0,
        x_scale=(0.1, 0.1, 0.1),
        diff_step=(1e-2, 1e-2, 1e-2),
    )
    remaining = residual(solution.x)
    spread = float(np.sqrt(np.mean(remaining**2)))
    jacobian = np.asarray(solution.jac)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * spread**2 / period
    return AirFit(
        fill_lag=float(solution.x[0]),
        vent_lag=float(solution.x[1]),
        delay=float(solution.x[2]),
        fill_rate=_fill_rate(command, measured, period),
        offset=offset,
        residual=spread,
        uncertainty=np.sqrt(np.diag(covariance)),
    )


def _smooth_rows(command: Array, period: float) -> NDArray[np.bool_]:
    jump = np.abs(np.diff(command, axis=0, prepend=command[:1])) > SMOOTH_RATE * period
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
