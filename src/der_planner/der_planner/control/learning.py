"""Learning from run to run of one motion.

A run's measured tip y at the setpoints' instants, less the tip that the model expects under the
commands that were played, is a disturbance d(t) = y(t) − model(u)(t): what the model does not
explain. The next plan is the optimum of |model(u) + d − r̄|² under all limits, pulled weakly toward
the commands of the run (`der_planner.planning.correction`). Only the share α of the error is asked
to go away, model(u) + d = r̄ + (1 − α) e with e the error that is there; α is 1 until a run is worse
than the best one.

d is filtered from run to run, setpoint by setpoint, with the gain p / (p + r): p is the variance of
what is known of d, r that of the measurement. Where the tip was not seen, the gain is 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter1d

from der_planner.planning.correction import Correction
from der_planner.planning.errors import PlanningError
from der_planner.planning.result import Plan

Array = NDArray[np.float64]

_LONGEST_STEP = 0.15
"""Between two images further apart the tip counts as unseen [s]."""
_FADE = 0.25
"""Time over which what was measured fades in at the edge of a gap [s]."""
_SMOOTHING = 0.05
"""Standard deviation of the filter on the measured disturbance [s]."""
_LEAST_SEEN = 0.5
"""Share of the setpoints at which the tip must be seen."""
_STRANGE = 4.0
"""A run with an error this many times the largest one before is not of this limb …"""
_STRANGE_ERROR = 5e-3
"""… if the error is also larger than this [m]."""
_NOT_FOLLOWED = 0.7
"""Share of the motion's own mean distance from its start that an error must stay below."""
_CHANGE = 2e-4
"""By so much d changes from run to run, because the commands change (standard deviation) [m]."""
_UNKNOWN = 0.1
"""Standard deviation of d before the first run [m]."""
_NOISE = 1e-4
"""Standard deviation of a measured tip whose covariance is not given [m]."""
_REPEATABILITY = 1e-4
"""Mean error by which two runs of one plan differ, until such runs were seen [m]."""
_SMALLEST_STEP = 0.1
"""α below which learning stops."""
_NOISE_ONLY = 1.5
"""Learning stops at a mean error of so many times the repeatability that repeats have shown."""


class LearningError(ValueError):
    """A run or a plan cannot be learned from; the message names the remedy."""


@dataclass(frozen=True)
class LearningRun:
    """What one run was worth.

    Attributes:
        number: of the run, from 1.
        mean_error, largest_error: distance of the measured tip from r̄ where it was seen [m].
        seen: share of the setpoints at which the tip was seen.
        accepted: the run was used.
        step: α of the plan that follows it.
        reason: what was done with the run and why.
    """

    number: int
    mean_error: float
    largest_error: float
    seen: float
    accepted: bool
    step: float
    reason: str


@dataclass(frozen=True)
class _Best:
    plan: Plan
    error: Array
    disturbance: Array


class Learner:
    """Plans a motion anew from what its runs have shown.

    Args:
        plan: the first one played, of the model ``der``.

    Attributes:
        history: one entry for each run that was added.
        stopped: why nothing more is learned; empty while it goes on.

    Raises:
        LearningError: the plan is one of the model ``pcc``, which has no optimiser.
    """

    def __init__(self, plan: Plan) -> None:
        try:
            self._correction = Correction(plan)
        except PlanningError as error:
            raise LearningError(str(error)) from error
        self.history: list[LearningRun] = []
        self.stopped = ""
        self._plan = plan
        self._model_tip = self._correction.tip(plan.differential_pressure)
        self._known = np.zeros_like(plan.tip_reference)
        self._variance = np.full(len(plan.time), _UNKNOWN**2)
        self._best: _Best | None = None
        self._last: _Best | None = None
        self._step = 1.0
        self._differences: list[float] = []
        self._fresh = False
        self._runs_of_plan = 0

    @property
    def repeatability(self) -> float:
        """Mean distance of the tip between runs of one plan, over √2 [m]."""
        return float(np.mean(self._differences)) if self._differences else _REPEATABILITY

    def add(self, time: ArrayLike, tip: ArrayLike, covariance: ArrayLike | None = None) -> None:
        """Take in a run of the plan that `next` gave last, or of the first plan.

        Several runs of one plan, added one after the other, tell how well the limb repeats.

        Args:
            time: (K,) rising instants since the plan's first setpoint [s].
            tip: (K, 2) measured [m]; NaN where the limb was not seen.
            covariance: (K, 2, 2) of the tip [m²].

        Raises:
            LearningError: the arrays do not fit together.
        """
        measured, variance, seen = self._at_setpoints(*_checked(time, tip, covariance))
        error = np.where(seen[:, None], measured - self._plan.tip_reference, np.nan)
        distance = np.linalg.norm(error[seen], axis=1)
        mean = float(distance.mean()) if seen.any() else float("nan")
        refused = self._refusal(seen, mean)
        if refused:
            said = f"refused: {refused}"
        else:
            said = self._take(measured, variance, seen, error)
            self._fresh = True
        largest = float(distance.max()) if seen.any() else float("nan")
        number = len(self.history) + 1
        self.history.append(
            LearningRun(number, mean, largest, float(seen.mean()), not refused, self._step, said)
        )

    def next(self) -> Plan:
        """Return the plan to play next; the same one again if nothing new was learned.

        Raises:
            PlanningError: the optimiser found no plan.
        """
        if not self._fresh or self._best is None or self._last is None:
            return self._plan
        self._fresh = False
        base = self._best if self.stopped or self._step < 1.0 else self._last
        if self.stopped:
            following = base.plan
        else:
            left = (1.0 - self._step) * np.nan_to_num(base.error)
            commands = base.plan.differential_pressure
            following = self._correction.plan(commands, base.disturbance - left)
        if not np.array_equal(following.differential_pressure, self._plan.differential_pressure):
            self._runs_of_plan = 0
        self._plan = following
        self._model_tip = self._correction.tip(following.differential_pressure)
        return following

    def _at_setpoints(
        self, time: Array, tip: Array, variance: Array
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return tip (K, 2), its variance (K,) and where it was seen, at the setpoints."""
        setpoints = self._plan.time
        valid = np.isfinite(tip).all(axis=1) & np.isfinite(variance)
        if valid.sum() < 2:
            return np.full((len(setpoints), 2), np.nan), np.ones(len(setpoints)), setpoints < 0
        clock = time[valid]
        values = [np.interp(setpoints, clock, column) for column in tip[valid].T]
        after = np.clip(np.searchsorted(clock, setpoints), 1, len(clock) - 1)
        near = np.minimum(np.abs(setpoints - clock[after - 1]), np.abs(clock[after] - setpoints))
        between = clock[after] - clock[after - 1] <= _LONGEST_STEP
        inside = (setpoints >= clock[0] - 1e-9) & (setpoints <= clock[-1] + 1e-9)
        seen = (inside & between) | (near < 1e-3)
        return np.column_stack(values), np.interp(setpoints, clock, variance[valid]), seen

    def _refusal(self, seen: NDArray[np.bool_], mean: float) -> str:
        """Return why a run must not be used; empty if it may."""
        if seen.mean() < _LEAST_SEEN:
            return (
                f"the tip was seen at {seen.mean():.0%} of the setpoints, {_LEAST_SEEN:.0%} are "
                "needed: see to the tags and play it again"
            )
        wanted = self._plan.tip_reference
        way = float(np.linalg.norm(wanted - wanted[0], axis=1).mean())
        if mean > _NOT_FOLLOWED * way:
            return (
                f"the mean error of {mean * 100:.2f} cm is that of a limb that does not follow: "
                "was it vented, is it the limb of the plan?"
            )
        before = [run.mean_error for run in self.history if run.accepted]
        if before and mean > max(_STRANGE * max(before), _STRANGE_ERROR):
            return (
                f"the mean error of {mean * 100:.2f} cm is more than {_STRANGE:.0f} times what it "
                "ever was: the limb, its load or its rest has changed; calibrate and start again"
            )
        return ""

    def _take(self, measured: Array, variance: Array, seen: NDArray[np.bool_], error: Array) -> str:
        """Filter the disturbance and weigh the run against the best; return what was done."""
        period = float(self._plan.time[1] - self._plan.time[0])
        prior = self._variance + (_CHANGE**2 if self._runs_of_plan == 0 else 0.0)
        gain = prior / (prior + variance)
        shown = np.where(seen[:, None], measured - self._model_tip, self._known)
        shown = gaussian_filter1d(shown - self._known, _SMOOTHING / period, axis=0, mode="nearest")
        edge = np.ones(len(seen))
        if not seen.all():
            edge = np.clip(distance_transform_edt(seen) * period / _FADE, 0.0, 1.0)
        self._known = self._known + (edge * gain)[:, None] * shown
        self._variance = np.where(seen, (1.0 - gain) * prior, prior)
        if self._runs_of_plan and self._last is not None:
            apart = np.linalg.norm(error - self._last.error, axis=1)
            if np.isfinite(apart).any():
                self._differences.append(float(np.nanmean(apart) / np.sqrt(2)))
        self._runs_of_plan += 1
        self._last = _Best(self._plan, error, self._known.copy())
        return self._weigh(self._last)

    def _weigh(self, run: _Best) -> str:
        """Choose best run and step; return what was decided and why."""
        if self.stopped:
            return f"the best plan was played again: {self.stopped}"
        best = self._best
        if best is None:
            self._best = run
            return "the first run"
        both = np.isfinite(run.error).all(axis=1) & np.isfinite(best.error).all(axis=1)
        new, old = (
            float(np.linalg.norm(entry.error[both], axis=1).mean()) for entry in (run, best)
        )
        said = f"{new * 100:.3f} cm after {old * 100:.3f} cm where both were seen"
        if new <= old:
            self._best, self._step = run, min(1.0, 2 * self._step)
        elif new > old + self.repeatability:
            self._step /= 2
            said += f": worse than the best run, back to it with a step of {self._step:.2f}"
        if self._differences and min(new, old) < _NOISE_ONLY * self.repeatability:
            self.stopped = f"only noise is left: runs differ by {self.repeatability * 100:.3f} cm"
        elif self._step < _SMALLEST_STEP:
            self.stopped = "no smaller step makes the best run better"
        return f"{said}; stopped, {self.stopped}" if self.stopped else said


def _checked(
    time: ArrayLike, tip: ArrayLike, covariance: ArrayLike | None
) -> tuple[Array, Array, Array]:
    """Return time (K,), tip (K, 2) and variance of a coordinate (K,)."""
    clock, place = np.asarray(time, dtype=float), np.asarray(tip, dtype=float)
    if clock.ndim != 1 or place.shape != (len(clock), 2) or not np.all(np.diff(clock) > 0):
        raise LearningError(
            "a run needs rising times (K,) and tips (K, 2), got shapes "
            f"{clock.shape} and {place.shape}: take both from the same recording"
        )
    if covariance is None:
        return clock, place, np.full(len(clock), _NOISE**2)
    spread = np.asarray(covariance, dtype=float)
    if spread.shape != (len(clock), 2, 2):
        raise LearningError(f"covariance must have shape ({len(clock)}, 2, 2), got {spread.shape}")
    return clock, place, np.trace(spread, axis1=1, axis2=2) / 2
