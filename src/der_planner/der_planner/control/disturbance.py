"""What one run showed beyond its model: the disturbance d = measured tip − expected tip.

The measured tip comes at the camera's instants, with noise and gaps; d is wanted at the setpoints.
The expected tip is taken to the camera's instants by a cubic spline, where it is known without
noise, and the difference, which is small and changes slowly, is smoothed back to the setpoints by
straight lines fitted in a Gaussian neighbourhood, with the tracker's covariance as weight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from der_planner.arrays import Array, interpolate

Mask = NDArray[np.bool_]

_NEIGHBOURHOOD = 0.05
"""Standard deviation of the neighbourhood in which a line is fitted [s]."""
_REACH = 3.0
"""Number of standard deviations beyond which samples do not count."""
_SEEN_WITHIN = 0.1
"""Distance of the nearest image up to which a setpoint counts as seen [s]."""
_FARTHEST = 3.0
"""A tip farther from the clamp, over the limb's length, is told in another unit."""
_LONGEST = 30.0
"""So is a run that takes longer, over its plan's duration."""
_LEAST_NOISE = 1e-5
"""Standard deviation of the best tip that is believed [m]."""
_BEHIND_SHARE = 0.6
"""Error of a limb that stays behind, as a share of its reference's distance from the start."""
_BEHIND_DISTANCE = 0.02
"""Distance of the reference from the start from which a limb can be said to stay behind [m]."""
_BEHIND_TIME = 1.0
"""Time for which a limb must stay behind [s]."""
_NOT_THESE = 0.5
"""Error of the chambers, over what they hold, from which on they are not those of the run."""
_USUAL_ERROR = 1.5
"""Multiple of the median error up to which a limb still followed."""
_MOST_LATE, _LATE = 40, 4
"""Setpoints by which a tip is looked for to be later or earlier, and from which on it is said."""
_LATE_SHARE = 0.2
"""Share of a tip's squared error that is left without this time, if it is wrong: at 0.3 s, 0.01 to
0.18 on calibrated chains of links; friction and slow air leave 0.5 or more on uncalibrated ones."""
_LEAST_CORRELATION = 0.5
"""Correlation of measured and expected tip of a limb that moves with its commands."""
_LEAST_MOVEMENT = 0.15
"""Share of the expected movement that a limb makes that moves with its commands."""
STILL = 5e-3
"""Expected movement below which nothing is told of a limb, root mean square [m]."""
_ELSEWHERE = 0.4
"""Share of a limb's length from which on its tip begins elsewhere than it can."""
_FIRST = 5
"""Setpoints at which a limb begins."""


class LearningError(ValueError):
    """A run or a plan cannot be learned from; the message names the remedy."""


@dataclass(frozen=True)
class Measured:
    """A run's tip as it was filmed.

    Attributes:
        time: (K,) rising instants since the plan's first setpoint, where the tip was seen [s].
        tip: (K, 2) [m].
        variance: (K,) of a coordinate [m²]; None where the tracker gave none.
    """

    time: Array
    tip: Array
    variance: Array | None

    @classmethod
    def build(cls, time: ArrayLike, tip: ArrayLike, covariance: ArrayLike | None) -> Measured:
        """Check a run's arrays and leave out what was not seen.

        Args:
            time: (K,) [s].
            tip: (K, 2), NaN where unseen [m].
            covariance: (K, 2, 2) [m²]; None: not known. A row that is not finite is left out.

        Raises:
            LearningError: shapes that do not fit, or instants that do not rise.
        """
        clock, place = np.asarray(time, dtype=float), np.asarray(tip, dtype=float)
        shapes_fit = clock.ndim == 1 and place.shape == (len(clock), 2)
        if not shapes_fit or not np.all(np.diff(clock) > 0):
            raise LearningError(
                "a run needs rising times (K,) and tips (K, 2), got shapes "
                f"{clock.shape} and {place.shape}: take both from the same recording"
            )
        seen = np.isfinite(place).all(axis=1)
        if covariance is None:
            return cls(clock, place, None).only(seen)
        spread = np.asarray(covariance, dtype=float)
        if spread.shape != (len(clock), 2, 2):
            raise LearningError(
                f"covariance must have shape ({len(clock)}, 2, 2), got {spread.shape}"
            )
        variance = np.trace(spread, axis1=1, axis2=2) / 2
        seen &= np.isfinite(variance) & (variance >= 0)
        return cls(clock, place, np.maximum(variance, _LEAST_NOISE**2)).only(seen)

    def only(self, rows: Mask) -> Measured:
        """Return some of the rows (K,)."""
        variance = None if self.variance is None else self.variance[rows]
        return Measured(self.time[rows], self.tip[rows], variance)

    def check_units(self, length: float, duration: float) -> None:
        """Refuse tips and instants that no run can have: in millimetres, or milliseconds.

        Args:
            length: of the limb [m].
            duration: of the plan [s].

        Raises:
            LearningError: names what was given and what is expected.
        """
        if not len(self.time):
            return
        far = float(np.median(np.linalg.norm(self.tip, axis=1)))
        if far > _FARTHEST * length:
            raise LearningError(
                f"the tips are {far:.3g} m from the clamp of a limb of {length:.3g} m: give metres"
            )
        first, last = float(self.time[0]), float(self.time[-1])
        if max(-first, last) > _LONGEST * duration:
            raise LearningError(
                f"the run goes from {first:.6g} to {last:.6g} s, its plan takes {duration:.3g} s: "
                "give seconds since the plan's first setpoint"
            )


@dataclass(frozen=True)
class Shown:
    """The disturbance of one run at the K setpoints.

    Attributes:
        value: (K, 2) measured less expected tip [m]; NaN where the tip was not seen.
        variance: (K,) of a coordinate, by the camera's noise [m²].
        seen: (K,).
    """

    value: Array
    variance: Array
    seen: Mask


def disturbance(measured: Measured, setpoints: Array, expected: Array) -> Shown:
    """Return what a run showed beyond its model.

    Args:
        measured: the run.
        setpoints: (K,) instants [s].
        expected: (K, 2) tip of the model under the commands that were played [m].
    """
    inside = (measured.time >= setpoints[0]) & (measured.time <= setpoints[-1])
    time, tip = measured.time[inside], measured.tip[inside]
    count = len(setpoints)
    value, variance = np.full((count, 2), np.nan), np.full(count, np.inf)
    if len(time) < 2:
        return Shown(value, variance, np.zeros(count, dtype=bool))
    beyond = tip - CubicSpline(setpoints, expected)(time)
    given = measured.variance
    noise = np.full(len(time), _scatter(beyond)) if given is None else given[inside]
    first = np.searchsorted(time, setpoints - _REACH * _NEIGHBOURHOOD)
    last = np.searchsorted(time, setpoints + _REACH * _NEIGHBOURHOOD, side="right")
    for k, (begin, end) in enumerate(zip(first, last, strict=True)):
        gap = time[begin:end] - setpoints[k]
        if not len(gap) or np.abs(gap).min() > _SEEN_WITHIN:
            continue
        near = np.exp(-0.5 * (gap / _NEIGHBOURHOOD) ** 2)
        rows = _rows_of_line(gap, near / noise[begin:end])
        value[k] = rows @ beyond[begin:end]
        variance[k] = rows**2 @ noise[begin:end]
    return Shown(value, variance, np.isfinite(value).all(axis=1))


def _rows_of_line(gap: Array, weight: Array) -> Array:
    """Return the weights (n,) by which samples at distances (n,) give a line's value at zero."""
    total, first, second = weight.sum(), weight @ gap, weight @ gap**2
    spread = total * second - first**2
    # Samples on one side only: a line would be drawn out; their mean is not.
    if spread <= 1e-12 * total * second or gap.min() > 0 or gap.max() < 0:
        mean: Array = weight / total
        return mean
    rows: Array = weight * (second - first * gap) / spread
    return rows


def _scatter(values: Array) -> float:
    """Return the variance of a coordinate [m²] by which samples (K, 2) leave a smooth curve.

    From their second differences, which have six times the variance of white noise.
    """
    if len(values) < 8:
        return 1e-8
    bends = np.diff(values, 2, axis=0)
    deviation = 1.4826 * float(np.median(np.abs(bends))) / np.sqrt(6.0)
    return float(max(deviation, _LEAST_NOISE) ** 2)


def stays_behind(time: Array, tip: Array, wanted: Array) -> float | None:
    """Return the instant [s] from which a limb does not follow its reference, e.g. vented, or None.

    Args:
        time: (K,) setpoints [s].
        tip: (K, 2), NaN where unseen [m].
        wanted: (K, 2) r̄ [m].
    """
    distance = np.linalg.norm(wanted - wanted[0], axis=1)
    missed = np.linalg.norm(tip - wanted, axis=1)
    with np.errstate(invalid="ignore"):
        behind = (missed > _BEHIND_SHARE * distance) & (distance > _BEHIND_DISTANCE)
    needed = max(2, round(_BEHIND_TIME / float(time[1] - time[0])))
    # A gap in between neither ends such a stretch nor makes it longer.
    seen = np.flatnonzero(np.isfinite(missed))
    if len(seen) < needed:
        return None
    whole = np.convolve(behind[seen], np.ones(needed), "valid") > needed - 0.5
    if not whole.any():
        return None
    # It began when the error left what it had been until then.
    before = missed[seen[: int(np.argmax(whole))]]
    usual = _USUAL_ERROR * float(np.median(before)) if len(before) else 0.0
    well = np.flatnonzero(before <= usual)
    return float(time[seen[well[-1]]] if len(well) else time[0])


def moves_with(tip: Array, expected: Array) -> str:
    """Return why a limb cannot be said to move with its commands; empty if it does.

    One with another gain or rest angle misses its path by far and still moves with its commands;
    one that is vented, stuck or not connected does not.

    Args:
        tip: (K, 2), NaN where unseen [m].
        expected: (K, 2) tip of the model under the commands [m].
    """
    seen = np.isfinite(tip).all(axis=1)
    if not seen.any():
        return ""
    moved, expected_movement = movement(tip[seen]), movement(expected[seen])
    if expected_movement < STILL:
        return ""
    if moved < _LEAST_MOVEMENT * expected_movement:
        return f"the tip moved {moved / expected_movement:.0%} of its way"
    one, other = (part[seen] - part[seen].mean(axis=0) for part in (tip, expected))
    alike = float((one * other).sum() / seen.sum()) / (moved * expected_movement)
    if alike < _LEAST_CORRELATION:
        return f"the tip does not move with the commands (correlation {alike:.2f})"
    return ""


def later(tip: Array, expected: Array) -> int:
    """Return by how many setpoints a tip is later than the model's, if that is most of its error.

    A slower limb, or one with friction, comes late too, but little of its error is that alone.

    Args:
        tip: (K, 2), NaN where unseen [m].
        expected: (K, 2) tip of the model under the commands [m].
    """
    left: dict[int, float] = {}
    most = min(_MOST_LATE, len(tip) // 2)
    for lag in range(-most, most + 1):
        end = len(tip) - abs(lag)
        apart = tip[max(lag, 0) :][:end] - expected[max(-lag, 0) :][:end]
        apart = apart[np.isfinite(apart).all(axis=1)]
        left[lag] = movement(apart) ** 2 if len(apart) > end // 2 else math.inf
    best = min(left, key=lambda lag: left[lag])
    return best if abs(best) >= _LATE and left[best] < _LATE_SHARE * left[0] < math.inf else 0


def movement(tip: Array) -> float:
    """Return the root mean square distance of tips (K, 2) from their mean [m]; 0 for none."""
    return float(np.sqrt(tip.var(axis=0).sum())) if len(tip) else 0.0


def elsewhere(shown: Shown, length: float) -> str:
    """Return why the tips cannot be those of a limb where it begins; empty if they can.

    Args:
        shown: of the run.
        length: of the limb [m].
    """
    first = shown.value[shown.seen][:_FIRST]
    apart = float(np.linalg.norm(np.median(first, axis=0))) if len(first) else 0.0
    if apart < _ELSEWHERE * length:
        return ""
    return (
        f"the tip begins {apart * 1000:.0f} mm from where the model does: check that the tips "
        "count from the clamp, x along the straight limb and y to its left, and what it carries"
    )


def without_gaps(value: Array, known: Mask, period: float, fade: float) -> Array:
    """Return a disturbance (K, 2) with its gaps bridged.

    Between two instants where it is known by a straight line, at the ends by the last known value,
    which fades away.

    Args:
        value: (K, 2) [m], anything where it is not known.
        known: (K,).
        period: of the instants [s].
        fade: time in which an end's value falls to a third [s].
    """
    if known.all() or not known.any():
        return np.where(known[:, None], value, 0.0)
    place = np.arange(len(value))
    there = place[known]
    result = interpolate(place, there, value[known])
    outside = np.maximum(there[0] - place, 0) + np.maximum(place - there[-1], 0)
    faded: Array = result * np.exp(-outside * period / fade)[:, None]
    return faded


def chambers_beyond(
    expected: Array, setpoints: Array, time: ArrayLike, measured: ArrayLike
) -> Array | None:
    """Return by how much the chambers held more than their model in each period (K, M) [Pa].

    Args:
        expected: (K, M) mean differential pressures of the model in each period [Pa].
        setpoints: (K,) beginnings of the periods [s].
        time: (n,) instants, in any order [s].
        measured: (n, M) differential pressures in the chambers then [Pa].

    Returns:
        None where no whole readings are of the run; 0 outside of the first and last reading.

    Raises:
        LearningError: shapes that do not fit, or pressures that are not those of the run.
    """
    instants, values = np.asarray(time, dtype=float), np.asarray(measured, dtype=float)
    wanted = (len(instants), expected.shape[1])
    if instants.ndim != 1 or values.shape != wanted:
        raise LearningError(
            f"chambers need instants (n,) and pressures {wanted}, got shapes {instants.shape} and "
            f"{values.shape}: take both from the same recording"
        )
    whole = np.isfinite(instants) & np.isfinite(values).all(axis=1)
    if not whole.any():
        return None
    order = np.argsort(instants[whole], kind="stable")
    instants, values = instants[whole][order], values[whole][order]
    period = setpoints[1] - setpoints[0]
    middle = setpoints + 0.5 * period
    told = (middle > instants[0] - period) & (middle < instants[-1] + period)
    if not told.any():
        return None
    beyond = np.where(told[:, None], interpolate(middle, instants, values) - expected, 0.0)
    missed, usual = (float(np.sqrt(np.mean(each[told] ** 2))) for each in (beyond, expected))
    if missed > _NOT_THESE * usual:
        raise LearningError(
            f"the chambers are {missed:.0f} Pa away from the {usual:.0f} Pa that the commands make "
            "of them, root mean square: give Pa, segment by segment from the clamp, or look for a "
            "chamber that leaks"
        )
    return beyond
