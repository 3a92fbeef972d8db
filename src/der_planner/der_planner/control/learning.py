"""Learning from run to run of one motion.

A run's measured tip less the tip that the model expects under the commands that were played is a
disturbance d(t) = y(t) − model(u)(t): what the model does not explain. The next plan is the optimum
of |model(u) + D − r̄|² under all limits, pulled weakly toward the best commands so far
(`der_planner.planning.correction`), with D the mean of the runs' disturbances. A run counts in D by
the inverse of its variance: what does not repeat, the camera's noise, and what the model's answer
to the change of commands since then may lack (`der_planner.control.repeatability`). On a limb that
repeats the last runs decide; on one that does not, all runs are averaged.

Guards: plans are judged by the error that all runs together say they leave. A plan that is worse
than the best one is left, and the next step from the best one is half as long (the share α of the
error that is asked to go) and pulled harder. Learning stops when only noise is left, when runs
bring nothing more, or when no smaller step helps.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.control.disturbance import (
    LearningError,
    Measured,
    Shown,
    disturbance,
    stays_behind,
    without_gaps,
)
from der_planner.control.repeatability import Pair, Repeatability, estimate
from der_planner.planning.correction import Correction, Expected
from der_planner.planning.errors import PlanningError
from der_planner.planning.result import Plan

Array = NDArray[np.float64]

_LEAST_SEEN = 0.2
"""Share of the setpoints at which the tip must be seen."""
_FADE = 2.0
"""Time in which what was learned fades beyond the first and last picture [s]."""
_UNLIKE = 4.0
"""A run that differs from the others by so many standard deviations is not one of them …"""
_NOTABLE = 1.5e-3
"""… if it also differs by more than this, root mean square [m]."""
PULL = 0.015
"""Pull toward the best commands, over the tip's way per pressure: the model's answer to a change of
commands is wrong by some per cent of the movement of each segment, even where they cancel at the
tip. (A weaker pull lets segments wander against each other near the straight pose, where the tip
hardly tells them apart.)"""
_HARDER = 3.0
"""The pull grows by this after a plan that was worse than the best one …"""
_HARDEST = 1.0
"""… up to this."""
_SMALLEST_STEP = 0.1
"""α below which learning stops."""
_ENOUGH_RUNS = 4.0
"""So many runs must tell what is left from noise before noise can stop learning."""
_PATIENCE = 3
"""Runs that bring nothing before learning stops."""
_NOTHING = 0.05
"""Share of the error that a run must take away to have brought something."""


@dataclass(frozen=True)
class LearningRun:
    """What one run was worth.

    Attributes:
        number: of the run, from 1.
        mean_error, largest_error: distance of the measured tip from r̄ at the camera's instants,
            where it was seen [m].
        seen: share of the setpoints at which the tip was seen.
        accepted: the run was used.
        step: α of the plan that follows it.
        repeatability: mean distance between a run and the mean of many runs of one plan, as far as
            it is known by now [m].
        reason: what was done with the run and why.
    """

    number: int
    mean_error: float
    largest_error: float
    seen: float
    accepted: bool
    step: float
    repeatability: float
    reason: str


@dataclass(frozen=True)
class _Played:
    """A run that can be used: what was commanded, expected and shown."""

    commands: Array
    expected: Expected
    shown: Shown


@dataclass(frozen=True)
class _Known:
    """What all runs together say of the disturbance under one plan.

    Attributes:
        value: D (K, 2), with gaps bridged [m].
        seen: (K,) where it was measured.
        runs: number of runs that it is worth, had they all been of this plan.
        variance: of a coordinate, mean over the motion [m²].
    """

    value: Array
    seen: NDArray[np.bool_]
    runs: float
    variance: float


class Learner:
    """Plans a motion anew from what its runs have shown.

    Args:
        plan: the first one played, by any method, or one that was learned before.

    Attributes:
        history: one entry for each run that was added.
        stopped: why nothing more is learned; empty while it goes on.

    Raises:
        LearningError: the plan's model is unknown, or its reference is out of reach.
    """

    def __init__(self, plan: Plan) -> None:
        try:
            self._correction = Correction(plan)
        except PlanningError as error:
            raise LearningError(str(error)) from error
        self.history: list[LearningRun] = []
        self._plan = plan
        self._pending: _Played | None = None
        self._begin([])

    def _begin(self, runs: list[_Played]) -> None:
        """Start (again) from runs of the limb as it is now."""
        self.stopped = ""
        self._runs = runs
        self._repeats = Repeatability()
        self._step, self._pull = 1.0, PULL * self._correction.lever
        self._best: _Played | None = None
        self._levels: list[float] = []
        self._fresh = False

    @property
    def repeatability(self) -> float:
        """Mean distance between a run and the mean of many runs of one plan [m].

        It is estimated from all runs, 0 before there are two.
        """
        return self._repeats.distance

    def add(
        self,
        time: ArrayLike,
        tip: ArrayLike,
        covariance: ArrayLike | None = None,
        *,
        commands: ArrayLike | None = None,
    ) -> None:
        """Take in a run of the plan that `next` gave last, or of the first plan.

        Several runs of one plan, added one after the other, tell how well the limb repeats.

        Args:
            time: (K,) rising instants since the plan's first setpoint [s].
            tip: (K, 2) measured [m]; NaN where the limb was not seen.
            covariance: (K, 2, 2) of the tip [m²]; None: estimated from the scatter of the tips.
            commands: (setpoints, M) that were in force in this run, if not those of the plan, for
                instance with what feedback added [Pa].

        Raises:
            LearningError: the arrays do not fit together or to the plan.
        """
        measured = Measured.build(time, tip, covariance)
        played, mean, largest = self._played(measured, commands)
        seen = float(played.shown.seen.mean())
        said = _refusal(seen)
        accepted = not said
        if accepted:
            accepted, said = self._take(played)
        else:
            said = f"refused: {said}"
        self.history.append(
            LearningRun(
                len(self.history) + 1,
                mean,
                largest,
                seen,
                accepted,
                self._step,
                self.repeatability,
                said,
            )
        )

    def next(self) -> Plan:
        """Return the plan to play next; the best one so far if nothing new was learned.

        Raises:
            PlanningError: the optimiser found no plan.
        """
        if self._best is None:
            return self._plan
        best = self._best
        if self.stopped or not self._fresh:
            self._plan = self._as_plan(best)
            return self._plan
        self._fresh = False
        known = self._known(best)
        error = best.expected.tip + known.value - self._plan.tip_reference
        target = known.value - (1.0 - self._step) * error
        following = self._correction.plan(best.commands, target, self._pull)
        # What is expected is the disturbance itself, whatever share of the error was asked to go.
        tip = following.tip_predicted - target + known.value
        self._plan = dataclasses.replace(following, tip_predicted=tip)
        return self._plan

    # One run ---------------------------------------------------------------------------------

    def _played(
        self, measured: Measured, commands: ArrayLike | None
    ) -> tuple[_Played, float, float]:
        """Return a run with its mean and largest error [m]."""
        plan = self._plan
        given = plan.differential_pressure
        if commands is not None:
            given = np.asarray(commands, dtype=float)
            if given.shape != plan.differential_pressure.shape or not np.isfinite(given).all():
                raise LearningError(
                    f"commands must be finite, of shape {plan.differential_pressure.shape}, got "
                    f"{given.shape}: give those of all setpoints of the plan"
                )
        expected = self._expected(given)
        shown = disturbance(measured, plan.time, expected.tip)
        tip = np.where(shown.seen[:, None], expected.tip + shown.value, np.nan)
        behind = stays_behind(plan.time, tip, plan.tip_reference)
        if behind is not None:
            kept = shown.seen & (plan.time < behind)
            shown = Shown(np.where(kept[:, None], shown.value, np.nan), shown.variance, kept)
        inside = (measured.time >= plan.time[0]) & (measured.time <= plan.time[-1])
        wanted = np.column_stack(
            [np.interp(measured.time[inside], plan.time, axis) for axis in plan.tip_reference.T]
        )
        distance = np.linalg.norm(measured.tip[inside] - wanted, axis=1)
        played = _Played(given, expected, shown)
        if not len(distance):
            return played, float("nan"), float("nan")
        return played, float(distance.mean()), float(distance.max())

    def _expected(self, commands: Array) -> Expected:
        for run in self._runs:
            if np.array_equal(run.commands, commands):
                return run.expected
        return self._correction.expected(commands)

    def _take(self, run: _Played) -> tuple[bool, str]:
        """Use a run; return whether it was used, and what was done and why."""
        unlike = self._unlike(run)
        if unlike:
            if self._pending is not None and not self._differ(run, self._pending):
                self._begin([self._pending])
                self._pending = None
                self._weigh(self._runs[0])
                self._use(run)
                return True, (
                    f"the limb has changed ({unlike}, as in the run before): learning starts again "
                    "from these two runs"
                )
            self._pending = run
            return False, (
                f"set aside: {unlike}; if the next run says the same, the limb, its load or its "
                "rest has changed and learning starts again"
            )
        self._pending = None
        return True, self._use(run)

    def _use(self, run: _Played) -> str:
        self._runs.append(run)
        self._repeats = estimate(self._pairs())
        self._fresh = not self.stopped
        return self._weigh(run)

    def _unlike(self, run: _Played) -> str:
        """Return how a run differs from all others; empty if it is one of them."""
        if not self._runs:
            return ""
        known = self._known(run)
        both = known.seen & run.shown.seen
        if not both.any():
            return ""
        apart = _rms(run.shown.value[both] - known.value[both])
        noise = self._repeats.deviation**2 + known.variance + run.shown.variance[both].mean()
        if len(self._runs) == 1:
            # What repeats is not known yet: no worse, surely, than the first run's error shows.
            noise += _rms(self._error(self._runs[0])[both]) ** 2
        if apart < max(_UNLIKE * np.sqrt(noise), _NOTABLE):
            return ""
        return f"it differs from the runs before by {apart * 100:.2f} cm"

    def _differ(self, one: _Played, other: _Played) -> bool:
        """Tell whether two runs that are unlike the others are unlike each other, too."""
        both = one.shown.seen & other.shown.seen
        known = self._known(one)
        from_others = _rms((one.shown.value - known.value)[both & known.seen])
        return _rms((one.shown.value - other.shown.value)[both]) > 0.5 * from_others

    # All runs --------------------------------------------------------------------------------

    def _movement(self, one: _Played, other: _Played) -> float:
        """Return how far a change of commands moves the tip, segment by segment, squared [m²]."""
        change = one.expected.pressure - other.expected.pressure
        return float((change**2).sum(axis=1).mean()) / 2 * self._correction.lever**2

    def _pairs(self) -> list[Pair]:
        result = []
        for place, one in enumerate(self._runs):
            for other in self._runs[:place]:
                both = one.shown.seen & other.shown.seen
                if both.any():
                    apart = one.shown.value[both] - other.shown.value[both]
                    noise = one.shown.variance[both].mean() + other.shown.variance[both].mean()
                    result.append(Pair(_rms(apart) ** 2, float(noise), self._movement(one, other)))
        return result

    def _known(self, about: _Played) -> _Known:
        """Return what all runs say of the disturbance under the commands of one of them."""
        count = len(self._plan.time)
        total, weights, squares = np.zeros((count, 2)), np.zeros(count), np.zeros(count)
        for run in self._runs:
            doubt = self._repeats.variance(self._movement(run, about)) + run.shown.variance
            weight = np.where(run.shown.seen, 1.0 / np.maximum(doubt, 1e-14), 0.0)
            total += weight[:, None] * np.nan_to_num(run.shown.value)
            weights += weight
            squares += weight**2
        seen = weights > 0
        value = total / np.where(seen, weights, 1.0)[:, None]
        period = float(self._plan.time[1] - self._plan.time[0])
        runs = float((weights[seen] ** 2 / squares[seen]).mean()) if seen.any() else 0.0
        variance = float((1.0 / weights[seen]).mean()) if seen.any() else 0.0
        return _Known(without_gaps(value, seen, period, _FADE), seen, runs, variance)

    def _error(self, run: _Played) -> Array:
        """Return what all runs say that the commands of one leave: tip less r̄ (K, 2) [m]."""
        known = self._known(run)
        error: Array = run.expected.tip + known.value - self._plan.tip_reference
        return error

    def _level(self, run: _Played) -> float:
        return float(np.linalg.norm(self._error(run), axis=1).mean())

    def _weigh(self, run: _Played) -> str:
        """Choose best plan, step and pull; return what was decided and why."""
        before = self._best
        if before is None:
            self._best = run
            self._levels = [self._level(run)]
            return "the first run"
        new, old = self._level(run), self._level(before)
        said = f"leaves {new * 100:.3f} cm after {old * 100:.3f} cm"
        same = np.array_equal(run.commands, before.commands)
        known = self._known(run)
        margin = self.repeatability / np.sqrt(max(known.runs, 1.0))
        if same:
            said += ", the same plan again"
        elif new > old + min(margin, old):
            self._step /= 2
            self._pull = min(self._pull * _HARDER, _HARDEST * self._correction.lever)
            said += f": worse than the best plan, back to it with a step of {self._step:.2f}"
        else:
            self._step = min(1.0, 2 * self._step)
        self._best = min((run, before), key=self._level)
        self._levels.append(self._level(self._best))
        if not self.stopped:
            self.stopped = self._reason_to_stop()
        return f"{said}; stopped: {self.stopped}" if self.stopped else said

    def _reason_to_stop(self) -> str:
        if self._best is None:
            return ""
        known, left = self._known(self._best), self._levels[-1]
        if known.runs >= _ENOUGH_RUNS and left < 0.5 * self.repeatability:
            return (
                f"only noise is left: runs of one plan differ by {self.repeatability * 100:.3f} cm"
            )
        if self._step < _SMALLEST_STEP:
            return "no smaller step makes the best plan better"
        if len(self._levels) > _PATIENCE:
            least = min(self._levels[-_PATIENCE:])
            if least > (1.0 - _NOTHING) * self._levels[-_PATIENCE - 1]:
                return (
                    f"the last {_PATIENCE} runs brought nothing: {left * 100:.3f} cm are left by "
                    "limits, reach or what does not repeat"
                )
        return ""

    def _as_plan(self, run: _Played) -> Plan:
        """Return the plan of a run's commands; what is expected of it is what all runs say."""
        if np.array_equal(run.commands, self._plan.differential_pressure):
            return self._plan
        return dataclasses.replace(
            self._plan,
            differential_pressure=run.commands,
            tip_predicted=run.expected.tip + self._known(run).value,
            method="learned",
        )


def _refusal(seen: float) -> str:
    """Return why a run must not be used of which this share was seen; empty if it may."""
    if seen >= _LEAST_SEEN:
        return ""
    return (
        f"the tip was seen following its reference at {seen:.0%} of the setpoints, "
        f"{_LEAST_SEEN:.0%} are needed: see to the tags and to the air, is it the limb of the "
        "plan?, and play it again"
    )


def _rms(values: Array) -> float:
    """Return the root mean square of a coordinate."""
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0
