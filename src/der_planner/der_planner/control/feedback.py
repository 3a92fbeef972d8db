"""Feedback within a run: commands that follow what camera and chambers show.

    f = Feedback(plan)
    f.pressures(time, differential)            # as often as the board tells them
    f.measure(time, bend_angle, tip)           # as pictures come, late and in any order
    f.command(time)                            # ahead of the instant, every 50 ms
    f.estimate(time)

All times are seconds since the plan's first setpoint. Nothing here knows the present: a command is
based on what was told before it was asked for.

A `Supervisor` decides on the share of the corrections that is sent. It goes from 0 to 1 once the
limb is seen, and back to 0, which is the plan alone, where feedback can do harm: the camera sees
nothing, or what it sees does not fit the model; corrections swing, or stay at what they are
allowed, and the tip is far from its path; commands are asked for too late. Lost tags may come back;
after the other reasons the rest of the run is played without feedback.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import ThreadpoolController

from der_planner.arrays import Array
from der_planner.control.estimation import Estimator
from der_planner.control.foresight import Foresight
from der_planner.control.horizon import Horizon
from der_planner.control.knowledge import Estimate
from der_planner.control.nominal import ChamberLog, Nominal
from der_planner.model import CONTROL_PERIOD
from der_planner.model.commands import within_limits
from der_planner.planning.plan_file import Plan

_THREADS = ThreadpoolController()
REASONS = {
    "tags lost": "the limb has not been seen for {:.1f} s",
    "inconsistent": "the limb moves as the model cannot, measurements are {:.0f} times too far off",
    "oscillation": "corrections swing by {:.0f} Pa, and neither they nor the limb come to rest",
    "saturation": "a correction is at its limit of {:.0f} Pa, and the tip far from its path",
    "late": "commands come {:.2f} s after their instant",
}
"""Every reason with the sentence of its warning."""
_GOES_ON = 0.7
"""Share of its largest swing below which something that swings begins or dies out."""


_AUTHORITY = 0.4
"""Largest correction, as a share of the limb's pressure limit."""
_RAMP = 1.0
"""Time in which feedback comes in [s]."""
_FADE = 1.5
"""Time in which feedback is taken back [s]."""
_BLIND = 0.5
"""Time without a measurement after which the tags are lost [s]."""
_KEPT = 1.0
"""Time after that in which the last disturbances are still made up for [s]."""
_INCONSISTENT = 20.0
"""Squared distance of measurements per coordinate, smoothed, that is too large; 1 is expected."""
_PATIENCE = 2.0
"""Time for which measurements may be inconsistent [s]."""
_SATURATED = 3.0
"""Time for which a correction may be at its limit [s]."""
_ASTRAY = 0.03
"""Distance of the tip from r̄, over the limb's length, up to which neither a correction at its limit
nor one that swings ends feedback: a limb that follows is not left to a plan that may be worse."""
_SWING = 0.1
"""Way from one turn of a swinging correction to the next, as a share of the authority."""
_TURNS = 6
"""Number of turns within the window that are an oscillation, unless it begins or dies out."""
_WINDOW = 4.0
"""Time in which the turns are counted [s]."""
_LATE = 4.0
"""Number of commands that may come too late; one in time makes up for half of one."""


@dataclass(frozen=True)
class Warned:
    """A reason for which feedback was taken back.

    Attributes:
        time: [s] of the plan.
        name: one of `REASONS`.
        message: a sentence with its number.
    """

    time: float
    name: str
    message: str


class Supervisor:
    """Decides on the share of the corrections that is sent; see the module.

    Args:
        authority: largest correction [Pa].
        length: of the limb [m].

    Attributes:
        share: 0 … 1.
        reason: for which feedback is out or going out; empty while it acts.
        warnings: all that were given.
    """

    def __init__(self, authority: float, length: float) -> None:
        self.authority, self.length = authority, length
        self.share = 0.0
        self.reason = ""
        self.warnings: list[Warned] = []
        self._latched = False
        self._since: dict[str, float] = {}
        self._late = 0.0
        self._astray_at = -math.inf
        self._recent: deque[tuple[Array, float]] = deque(maxlen=round(_WINDOW / CONTROL_PERIOD))

    def advance(self, time: float, age: float, strange: float) -> float:
        """Return the share of a command's correction.

        Args:
            time: instant of the command [s].
            age: of the newest measurement then [s].
            strange: squared distance of measurements per coordinate, smoothed.
        """
        if self._lasts("strange", strange > _INCONSISTENT, time) > _PATIENCE:
            self.stop(time, "inconsistent", strange)
        seen = age <= _BLIND
        if not seen and not self._latched and self.share > 0.0:
            self._warn(time, "tags lost", age)
        if seen and self.reason == "tags lost":
            self.reason = ""
        if self._latched or age > _BLIND + _KEPT:
            self.share = max(0.0, self.share - CONTROL_PERIOD / _FADE)
        elif seen:
            self.share = min(1.0, self.share + CONTROL_PERIOD / _RAMP)
        return self.share

    def sent(self, time: float, correction: Array, swing: float, missed: float = math.inf) -> None:
        """Look at a correction that is sent.

        Args:
            time: instant of the command [s].
            correction: (M,) [Pa].
            swing: rate at which the limb deviates from the model's motion then [rad/s].
            missed: distance of the tip from r̄ then [m]; if nobody tells, it is far.
        """
        astray = missed > _ASTRAY * self.length
        if astray:
            self._astray_at = time
        limited = np.abs(correction).max() > 0.98 * self.authority * self.share
        in_vain = bool(self.share > 0.0 and limited and astray)
        if self._lasts("in vain", in_vain, time) > _SATURATED:
            self.stop(time, "saturation", self.authority)
        self._recent.append((correction, swing))
        distance = self._oscillation()
        if distance > 0.0 and time - self._astray_at <= _WINDOW:
            self.stop(time, "oscillation", distance)

    def _lasts(self, what: str, now: bool, time: float) -> float:
        """Return for how long something has been so at an instant, without a break [s]."""
        if not now:
            self._since.pop(what, None)
            return 0.0
        return time - self._since.setdefault(what, time)

    def _oscillation(self) -> float:
        """Return how far a correction swings [Pa] if it and the limb swing on and on; else 0.

        After a push they swing more than before, and later less. A correction that is cut at its
        limit swings as far as before while the limb's swing dies out.
        """
        if len(self._recent) < (self._recent.maxlen or 0):
            return 0.0
        corrections, swings = (np.array(each) for each in zip(*self._recent, strict=True))
        third, least = len(swings) // 3, _SWING * self.authority
        if min(swings[:third].max(), swings[-third:].max()) < _GOES_ON * swings.max():
            return 0.0
        for series in corrections.T:
            distance = float(np.ptp(series))
            away = series - (series.max() + series.min()) / 2
            sides = np.sign(away[np.abs(away) > least / 2])
            goes_on = min(np.ptp(series[:third]), np.ptp(series[-third:])) >= _GOES_ON * distance
            if goes_on and np.count_nonzero(np.diff(sides)) >= _TURNS:
                return distance
        return 0.0

    def late(self, time: float, by: float) -> None:
        """Note that a command came after its instant [s], and by how much [s]."""
        self._late += 1.0
        if self._late >= _LATE:
            self.stop(time, "late", by)

    def in_time(self) -> None:
        """Note that a command is in time; it makes up for half a late one."""
        self._late = max(0.0, self._late - 0.5)

    def stop(self, time: float, name: str, number: float) -> None:
        """Play the rest without feedback, for one of `REASONS` and the number in its sentence."""
        if not self._latched:
            self._latched = True
            self._warn(time, name, number)

    def _warn(self, time: float, name: str, number: float) -> None:
        if self.reason != name:
            self.reason = name
            self.warnings.append(Warned(time, name, REASONS[name].format(number)))


class Feedback:
    """Corrects a plan while it is played.

    After the plan's end its last pose is held, for as long as commands are asked for.

    Args:
        plan: what is played; its limb, reference and commands are used.

    Attributes:
        plan: as given.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        authority = _AUTHORITY * plan.limb.pneumatics.pressure_limit
        length = sum(segment.length for segment in plan.limb.segments)
        self._supervisor = Supervisor(authority, length)
        with _THREADS.limit(limits=1, user_api="blas"):
            self._nominal = Nominal(plan)
            self._chambers = ChamberLog(self._nominal)
            self._estimator = Estimator(self._nominal, self._chambers)
            self._foresight = Foresight(self._nominal, self._estimator)
            self._horizon = Horizon(self._nominal, self._chambers, authority)
            self._horizon.warm_up(self._estimator.beginning(0))

    @property
    def reason(self) -> str:
        """Why feedback is out, or going out; empty while it acts."""
        return self._supervisor.reason

    @property
    def warnings(self) -> list[Warned]:
        """Every time that feedback was taken back, with its reason."""
        return self._supervisor.warnings

    @property
    def share(self) -> float:
        """Share of the corrections that is sent, 0 … 1."""
        return self._supervisor.share

    @property
    def trust(self) -> Array:
        """How far swing, slow and fast disturbances of each segment were predicted (3, M), 0 … 1.

        Corrections act on this share of each, see `der_planner.control.foresight`.
        """
        return self._foresight.trust.weights.copy()

    @property
    def innovations(self) -> list[tuple[float, float, int]]:
        """(time [s], squared normalised distance, coordinates) of every measurement."""
        return self._estimator.innovations

    def take_over(self, other: Feedback, time: float) -> None:
        """Go on where the feedback of another plan of this limb was, before anything is told.

        What it knows of the limb, the pressures and the share of its corrections stay, so that no
        command jumps where one motion gives way to another.

        Args:
            other: of the plan that is left.
            time: its instant at which this plan begins [s].
        """
        self._chambers.take_over(other._chambers, round(time / CONTROL_PERIOD))
        with _THREADS.limit(limits=1, user_api="blas"):
            self._estimator.take_over(other._estimator, time)
        self._foresight.take_over(other._foresight)
        # What ended the other's feedback does not count here.
        self._supervisor.share = other.share

    def pressures(self, time: float, differential: ArrayLike) -> None:
        """Take in the chambers' differential pressures (M,) [Pa], as measured at an instant [s].

        Raises:
            ValueError: another shape.
        """
        changed = self._chambers.read(time, differential)
        if changed is not None:
            self._estimator.changed(changed)

    def measure(
        self,
        time: float,
        bend_angle: ArrayLike,
        tip: ArrayLike,
        covariance: ArrayLike | None = None,
    ) -> None:
        """Take in what a picture showed. It may come late, and after a later one.

        Args:
            time: when the picture was taken [s].
            bend_angle: (M,) [rad]; NaN where a segment was not seen.
            tip: (2,) [m]; NaN if it was not seen.
            covariance: of the tip (2, 2) [m²], or of bend angles and tip (M + 2, M + 2).

        Raises:
            ValueError: another shape.
        """
        self._estimator.measure(time, bend_angle, tip, covariance)

    def command(self, time: float) -> Array:
        """Return the command (M,) [Pa] that takes effect at an instant [s] and holds for 50 ms.

        It keeps the limb's pressure and slew limits. To be asked for ahead of the instant, in
        order; asked for again, it is computed again.
        """
        k = round(time / CONTROL_PERIOD)
        instant = k * CONTROL_PERIOD
        supervisor = self._supervisor
        if instant <= self._chambers.newest - CONTROL_PERIOD:
            supervisor.late(instant, self._chambers.newest - instant)
        else:
            supervisor.in_time()
        planned, before = self._nominal.command(k), self._chambers.sent(k - 1)
        correction, swing, missed = np.zeros_like(planned), 0.0, 0.0
        try:
            # Matrices of some ten rows: more threads only get into other processes' way.
            with _THREADS.limit(limits=1, user_api="blas"):
                known = self._estimator.at(instant)
                self._foresight.learn()
                age = instant - self._estimator.newest
                swing = float(np.linalg.norm(known.parts[1]))
                missed = self._estimator.missed(known, k)
                share = supervisor.advance(instant, age, known.strange)
                if share > 0.0:
                    known = self._foresight.weighed(known, k)
                    correction = share * self._horizon.solve(k, known)
        except np.linalg.LinAlgError:
            correction[:] = np.nan
        if not np.isfinite(correction).all():
            supervisor.stop(instant, "inconsistent", np.inf)
            correction = np.zeros_like(planned)
        air = self._nominal.model.air
        command: Array = within_limits((planned + correction)[None], air, CONTROL_PERIOD, before)[
            0
        ][0]
        supervisor.sent(instant, command - planned, swing, missed)
        self._chambers.send(k, command)
        self._estimator.changed(instant)
        return command

    def coming(self) -> tuple[int, Array]:
        """Return the control period of the newest command, and corrections (W, M) [Pa] from it on.

        Those after the first are what would follow if nothing new were seen.
        """
        first, corrections = self._horizon.solution
        return first, self._supervisor.share * corrections

    def sent(self, time: float, command: ArrayLike) -> None:
        """Tell that another command (M,) [Pa] was sent for an instant [s] than was asked for."""
        k = round(time / CONTROL_PERIOD)
        self._chambers.send(k, np.asarray(command, dtype=float))
        self._estimator.changed(k * CONTROL_PERIOD)

    def late(self, time: float, by: float) -> None:
        """Tell that the command of an instant [s] could not be sent in time, and how late [s]."""
        self._supervisor.late(time, by)

    def estimate(self, time: float) -> Estimate:
        """Return the estimate of the limb at an instant [s], past or to come."""
        with _THREADS.limit(limits=1, user_api="blas"):
            return self._estimator.estimate(time)
