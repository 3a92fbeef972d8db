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
error that is asked to go) and pulled harder; so it is where a new plan is expected to be worse,
counting what its change of commands leaves in doubt. Learning stops when only noise is left, when
runs bring nothing more, or when no smaller step helps. Where the first run is far from what the
model expects, gains and rest angles of the model are taken from it
(`der_planner.identification.update`).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from der_planner.arrays import Array, interpolate
from der_planner.control.disturbance import (
    STILL,
    LearningError,
    Measured,
    Shown,
    chambers_beyond,
    disturbance,
    elsewhere,
    later,
    movement,
    moves_with,
    stays_behind,
)
from der_planner.control.repeatability import PlayedRun, Runs
from der_planner.identification.update import adapted
from der_planner.limb import Limb, LimbError
from der_planner.limb.plausible import TOO_SMALL, impossible
from der_planner.methods import LEARNED
from der_planner.model import CONTROL_PERIOD
from der_planner.planning.correction import PULL, Correction
from der_planner.planning.loads import PlanningError
from der_planner.planning.plan_file import Plan

_LEAST_SEEN = 0.2
"""Share of the setpoints at which the tip must be seen."""
_HARDER = 3.0
"""Factor by which the pull grows after a plan that was worse than the best one."""
_HARDEST = 1.0
"""Largest pull, over the tip's movement per pressure."""
_WORSE = 1.02
"""Share of the best plan's error that a plan may leave, beyond repeatability, and not be worse."""
_SHOWN_WORSE = 1.1
"""Share of the best plan's run that another run may miss by, before the best one is repeated."""
_SMALLEST_STEP = 0.1
"""α below which learning stops."""
_TRIES = 2
"""Plans that are tried, each with a smaller step, for one that is not expected to be worse."""
_ENOUGH_RUNS = 4.0
"""Learning stops at the noise only when D is worth this many runs."""
_PATIENCE = 3
"""Runs that bring nothing before learning stops."""
_NOTHING = 0.05
"""Share of the error that a run must take away to have brought something."""
_UNSEEN = np.full(1, np.nan)
_FIRST = "the first run"
_ADAPTED = (
    ", far from what the limb file expects: gains and rest angles of the model were taken from it; "
    "check_limb.py --update puts what a run tells into the file"
)


@dataclass(frozen=True)
class LearningRun:
    """What one run has shown, and what was done with it.

    Attributes:
        number: of the run, from 1.
        mean_error: distance of the measured tip from r̄ at the camera's instants, where it was
            seen [m].
        seen: share of the setpoints at which the tip was seen.
        accepted: the run was used.
        reason: what was done with the run and why.
    """

    number: int
    mean_error: float
    seen: float
    accepted: bool
    reason: str


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
            self._of_file = Correction(plan)
        except PlanningError as error:
            raise LearningError(str(error)) from error
        self.history: list[LearningRun] = []
        self._plan = plan
        self._pending: PlayedRun | None = None
        self._beyond: Array | None = None
        self._given = False
        self._begin()

    def _begin(self) -> None:
        """Start (again) with the limb as it is now."""
        self.stopped = ""
        self._correction = self._of_file
        period = float(self._plan.time[1] - self._plan.time[0])
        self._runs = Runs(self._plan.tip_reference, period, self._correction.tip_per_pressure)
        self._step, self._pull = 1.0, PULL
        self._best: PlayedRun | None = None
        self._levels: list[float] = []
        self._fresh = False

    @property
    def repeatability(self) -> float:
        """Mean distance between a run and the mean of many runs of one plan [m].

        It is estimated from all runs, 0 before there are two.
        """
        return self._runs.repeats.distance

    def add(
        self,
        time: ArrayLike,
        tip: ArrayLike,
        covariance: ArrayLike | None = None,
        *,
        commands: ArrayLike | None = None,
        chambers: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> None:
        """Take in a run of the plan that `next` gave last, or of the first plan.

        Several runs of one plan, added one after the other, tell how well the limb repeats.

        Args:
            time: (K,) rising instants since the plan's first setpoint [s].
            tip: (K, 2) measured [m]; NaN where the limb was not seen.
            covariance: (K, 2, 2) of the tip [m²]; None: estimated from the scatter of the tips.
            commands: (setpoints, M) that were in force in this run, if not those of the plan, for
                instance with what feedback added [Pa].
            chambers: instants (n,) [s] and what the chambers held then (n, M) [Pa], NaN where it is
                not known. Feedback on the learned plan then does not correct the same again.

        Raises:
            LearningError: the arrays do not fit together, to the plan or to the limb's length.
        """
        measured = Measured.build(time, tip, covariance)
        limb = self._correction.model.limb
        measured.check_units(limb.length, float(self._plan.time[-1]))
        measured = measured.only(~impossible(limb, "tips", measured.tip))
        played, missed, astray = self._played(measured, commands)
        seen = float(played.shown.seen.mean())
        beyond = None
        if chambers is not None:
            beyond = chambers_beyond(played.expected.pressure, self._plan.time, *chambers)
        refusal = _refusal(seen, astray)
        accepted, said = (False, refusal) if refusal else self._accept(played)
        if accepted and beyond is not None:
            self._beyond = beyond
        self._given = False
        number, mean = len(self.history) + 1, float(missed.mean())
        self.history.append(LearningRun(number, mean, seen, accepted, said))

    def next(self) -> Plan:
        """Return the plan to play next; until a run is added it stays the same.

        It is the best one so far if nothing new was learned.

        Raises:
            PlanningError: the optimiser found no plan.
        """
        best = self._best
        if best is None or self._given:
            return self._plan
        self._given = True
        known = self._runs.known(best)
        if self._fresh and not self.stopped:
            self._fresh = False
            self._plan = self._following(best, known.value)
        else:
            self._plan = self._again(best, known.value)
        if self._beyond is not None:
            self._plan = dataclasses.replace(self._plan, chambers_beyond=self._beyond)
        return self._plan

    def _following(self, best: PlayedRun, expected: Array) -> Plan:
        """Return a plan that is not expected to be worse than the best one, or that one again.

        What is expected counts with its doubt, which a smaller change of commands makes less.

        Args:
            best: run.
            expected: the disturbance (K, 2) [m].
        """
        level = self._runs.level(best)
        for _ in range(_TRIES):
            target = expected - (1.0 - self._step) * self._runs.error(best)
            following = self._correction.plan(best.commands, target, self._pull)
            # What is expected is the disturbance itself, whatever share of the error is to go.
            tip = following.tip_predicted - target + expected
            following = dataclasses.replace(following, tip_predicted=tip)
            doubt = self._runs.doubt(following.differential_pressure - best.commands)
            if math.hypot(following.predicted_error, doubt) <= _WORSE * level + self.repeatability:
                return following
            self._smaller_step()
        self.stopped = "no plan is expected to be better than the best one"
        return self._again(best, expected)

    def _again(self, best: PlayedRun, expected: Array) -> Plan:
        """Return the plan of the best run; where it is not the last, with what is expected now."""
        if np.array_equal(best.commands, self._plan.differential_pressure):
            return self._plan
        return dataclasses.replace(
            self._plan,
            differential_pressure=best.commands,
            tip_predicted=best.expected.tip + expected,
            method=LEARNED,
        )

    def _smaller_step(self) -> None:
        self._step /= 2
        self._pull = min(self._pull * _HARDER, _HARDEST)

    # One run ---------------------------------------------------------------------------------

    def _played(
        self, measured: Measured, commands: ArrayLike | None
    ) -> tuple[PlayedRun, Array, str]:
        """Return a run, its distances from r̄ where it was seen [m], and why its limb does not move.

        Distances of a run that was never seen are one NaN; the reason is empty for a limb that
        moves.
        """
        plan = self._plan
        given = plan.differential_pressure
        if commands is not None:
            given = np.asarray(commands, dtype=float)
            if given.shape != plan.differential_pressure.shape or not np.isfinite(given).all():
                raise LearningError(
                    f"commands must be finite, of shape {plan.differential_pressure.shape}, got "
                    f"{given.shape}: give those of all setpoints of the plan"
                )
            largest, planned = (float(np.abs(c).max()) for c in (given, plan.differential_pressure))
            if largest < TOO_SMALL * planned:
                raise LearningError(
                    f"the commands in force are {largest:.3g} Pa at the most, those of the "
                    f"plan {planned:.0f} Pa: give Pa"
                )
        expected = self._runs.expected(given) or self._correction.expected(given)
        shown = disturbance(measured, plan.time, expected.tip)
        astray = elsewhere(shown, self._correction.model.limb.length)
        tip = np.where(shown.seen[:, None], expected.tip + shown.value, np.nan)
        behind = stays_behind(plan.time, tip, plan.tip_reference)
        if behind is not None and not astray:
            kept = shown.seen & (plan.time < behind)
            follows = kept.mean() >= _LEAST_SEEN and movement(expected.tip[kept]) >= STILL
            # A limb that hardly ever follows may be far from its file, and teach all the same.
            astray = "" if follows else moves_with(tip, expected.tip)
            if follows or astray:
                shown = Shown(np.where(kept[:, None], shown.value, np.nan), shown.variance, kept)
        astray = astray or moves_with(expected.tip + shown.value, expected.tip)
        if not astray and (lag := later(tip, expected.tip)):
            side = "later" if lag > 0 else "earlier"
            astray = f"its times are {abs(lag) * CONTROL_PERIOD:.2g} s {side} than the plan's"
        inside = (measured.time >= plan.time[0]) & (measured.time <= plan.time[-1])
        wanted = interpolate(measured.time[inside], plan.time, plan.tip_reference)
        missed = np.linalg.norm(measured.tip[inside] - wanted, axis=1)
        return PlayedRun(given, expected, shown), missed if len(missed) else _UNSEEN, astray

    def _accept(self, run: PlayedRun) -> tuple[bool, str]:
        """Use a run; return whether it was used, and what was done and why."""
        unlike = self._runs.unlike(run)
        if unlike:
            if self._pending is not None and not self._runs.differ(run, self._pending):
                before, self._pending = self._pending, None
                self._begin()
                said = self._learn_from(before)
                said = self._learn_from(self._seen_by_model(run)) + said.removeprefix(_FIRST)
                return True, (
                    f"the limb has changed ({unlike}, as in the run before): learning starts again "
                    f"from these two runs; {said}"
                )
            self._pending = run
            if self._best is not None and not np.array_equal(run.commands, self._best.commands):
                self._smaller_step()  # the new commands may have done it
            return False, (
                f"set aside: {unlike}; if the next run says the same, the limb, its load or its "
                "rest has changed and learning starts again"
            )
        self._pending = None
        return True, self._learn_from(run)

    def _learn_from(self, run: PlayedRun) -> str:
        said = ""
        if self._best is None:
            run, said = self._adapt(run)
        self._runs.add(run)
        self._fresh = not self.stopped
        return self._weigh(run) + said

    def _adapt(self, first: PlayedRun) -> tuple[PlayedRun, str]:
        """Bring the model near a first run that is far from it; return the run as it sees it."""
        tip = first.expected.tip + first.shown.value

        def tip_of(limb: Limb) -> Array | None:
            try:
                return self._of_file.for_limb(limb).expected(first.commands).tip
            except (PlanningError, LimbError):
                return None

        nearer = adapted(self._of_file.model.limb, tip_of, tip)
        if nearer is None:
            return self._seen_by_model(first), ""
        self._correction = self._of_file.for_limb(nearer)
        return self._seen_by_model(first), _ADAPTED

    def _seen_by_model(self, run: PlayedRun) -> PlayedRun:
        """Return a run with its disturbance against the present model."""
        expected = self._correction.expected(run.commands)
        value = run.shown.value + run.expected.tip - expected.tip
        return PlayedRun(run.commands, expected, Shown(value, run.shown.variance, run.shown.seen))

    # All runs --------------------------------------------------------------------------------

    def _weigh(self, run: PlayedRun) -> str:
        """Choose best plan, step and pull; return what was decided and why."""
        before = self._best
        if before is None:
            self._best = run
            self._levels = [self._runs.level(run)]
            return _FIRST
        new, old = self._runs.level(run), self._runs.level(before)
        said = f"leaves {new * 100:.3f} cm after {old * 100:.3f} cm"
        known = self._runs.known(run)
        margin = self.repeatability / np.sqrt(max(known.runs, 1.0))
        self._best = min((run, before), key=self._runs.level)
        if np.array_equal(run.commands, before.commands):
            said += ", the same plan again"
        elif new > _WORSE * old + min(margin, old):
            self._smaller_step()
            said += f": worse than the best plan, back to it with a step of {self._step:.2f}"
        elif self._passes_for_noise(run, before):
            self._smaller_step()
            self._best, self._fresh = before, False
            said += ", but showed more: the best plan is played again, to see how well it repeats"
        else:
            self._step = min(1.0, 2 * self._step)
        self._levels.append(self._runs.level(self._best))
        if not self.stopped:
            self.stopped = self._reason_to_stop()
        return f"{said}; stopped: {self.stopped}" if self.stopped else said

    def _passes_for_noise(self, run: PlayedRun, before: PlayedRun) -> bool:
        """Tell whether a run that showed more than the best one is called noise, untried.

        Noise is what runs of one plan differ by. Where none was repeated, a limb whose friction
        answers small changes otherwise than its model looks noisy, too, and gets worse run by run.
        """
        showed, best = self._runs.missed(run), self._runs.missed(before)
        return not self._runs.repeated and showed > _SHOWN_WORSE * best

    def _reason_to_stop(self) -> str:
        if self._best is None:
            return ""
        known, left = self._runs.known(self._best), self._levels[-1]
        noisy = self._runs.repeated and left < 0.5 * self.repeatability
        if noisy and known.runs >= _ENOUGH_RUNS:
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


def _refusal(seen: float, astray: str) -> str:
    """Return why a run must not be used; empty if it may.

    Args:
        seen: share of the setpoints at which the tip was seen following.
        astray: why the limb is not said to move with its commands, if it does not.
    """
    said = [astray] if astray else []
    if seen < _LEAST_SEEN:
        said.insert(
            0,
            f"the tip was seen following its reference at {seen:.0%} of the setpoints, "
            f"{_LEAST_SEEN:.0%} are needed",
        )
    if not said:
        return ""
    return (
        f"refused: {'; '.join(said)}: see to the tags and to the air, is it the limb of the plan?, "
        "and play it again"
    )
