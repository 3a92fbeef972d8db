"""Feedback within a run: commands that follow what camera and chambers show.

    f = Feedback(plan)
    f.pressures(time, differential)            # as often as the board tells them
    f.measure(time, bend_angle, tip)           # as pictures come, late and in any order
    f.command(time)                            # ahead of the instant, every 50 ms
    f.estimate(time)

All times are seconds since the plan's first setpoint. Nothing here knows the present: a command is
based on what was told before it was asked for.

A `Supervisor` takes corrections back where they cannot help, a `Benefit` sends the share of them
that brings the tip nearer; what is done where something touches the limb is a `Reaction`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import ThreadpoolController

from der_planner.arrays import Array
from der_planner.control.benefit import Benefit
from der_planner.control.horizon import Horizon
from der_planner.control.reaction import Kind, Reaction
from der_planner.control.supervisor import Supervisor, Warned
from der_planner.estimation.estimator import Estimator
from der_planner.estimation.force import Touch
from der_planner.estimation.knowledge import Estimate
from der_planner.estimation.nominal import ChamberLog, Nominal
from der_planner.estimation.touch import TouchSense
from der_planner.limb.plausible import TOO_SMALL, impossible
from der_planner.model import CONTROL_PERIOD, STEPS
from der_planner.model.commands import within_limits
from der_planner.planning.plan_file import Plan

_THREADS = ThreadpoolController()
_AUTHORITY = 0.4
"""Largest correction, as a share of the limb's pressure limit."""
_SOON = 10
"""Coming commands that may be played before the next ones are known, and must keep off a touch."""
_AHEAD = 10.0
"""Instants so far beyond the newest command are of another clock, or in another unit [s]."""
_LONGEST = 1e5
"""So are those further from the first setpoint [s]."""
_UNHEARD = 0.3
"""Time without a reading of the chambers after which a picture tells of no touch [s]."""
_FILLED = 0.1
"""Command from which on chambers must hold something, as a share of the limb's pressure limit."""


class Feedback:
    """Corrects a plan while it is played.

    After the plan's end its last pose is held, for as long as commands are asked for.

    Args:
        plan: what is played; its limb, reference and commands are used.
        reaction: to something that touches the limb: "warn", "hold", "yield" or "vent". A limb that
            was never calibrated is not known well enough to yield: it warns.
        force_limit: force that is allowed then, with "yield" [N]; None: that of the plan.

    Attributes:
        plan: as given.
    """

    def __init__(
        self, plan: Plan, reaction: Kind = "yield", force_limit: float | None = None
    ) -> None:
        self.plan = plan
        authority = _AUTHORITY * plan.limb.pneumatics.pressure_limit
        if reaction == "yield" and not plan.limb.calibrated.differential_pressure:
            reaction, force_limit = "warn", None
        self._newest = 0.0
        self._supervisor = Supervisor(authority)
        with _THREADS.limit(limits=1, user_api="blas"):
            self._nominal = Nominal(plan)
            self._chambers = ChamberLog(self._nominal)
            self._estimator = Estimator(self._nominal, self._chambers)
            self._horizon = Horizon(self._nominal, self._chambers, authority)
            self._benefit = Benefit(self._nominal)
            self._sense = TouchSense(self._nominal.model)
            self._reaction = Reaction(self._nominal.model, reaction, force_limit)

    @property
    def reason(self) -> str:
        """Why feedback is out, or going out; empty while it acts."""
        return self._supervisor.reason

    @property
    def warnings(self) -> list[Warned]:
        """Every time that feedback was taken back or slowed, with its reason."""
        return self._supervisor.warnings

    @property
    def share(self) -> float:
        """Share of the corrections that is sent, 0 … 1."""
        return self._benefit.share * self._supervisor.share

    @property
    def touch(self) -> Touch:
        """What is known of something that touches the limb, at the newest picture."""
        return self._sense.newest

    @property
    def vents(self) -> bool:
        """Whether something touches the limb, for which it is to be vented."""
        return self._reaction.vents

    def remember(self, earlier: Feedback) -> None:
        """Begin with what an earlier run of this limb has told of it.

        That is how far the model is off where nothing touches the limb, its stiffness, and what
        corrections bring.
        """
        self._estimator.remember(earlier._estimator)
        self._sense.free = earlier._sense.free.for_next_run()
        self._benefit.remember(earlier._benefit)

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
        self._benefit.take_over(other._benefit)
        self._sense.free = other._sense.free
        # What ended the other's feedback does not count here.
        self._supervisor.share = other._supervisor.share
        self._supervisor.swings = other._supervisor.swings

    def pressures(self, time: float, differential: ArrayLike) -> None:
        """Take in the chambers' differential pressures (M,) [Pa], as measured at an instant [s].

        Raises:
            ValueError: another shape, or no time of the plan.
        """
        self._check(time)
        values, limb = np.asarray(differential, dtype=float), self.plan.limb
        beyond = bool(impossible(limb, "pressures", values))
        changed = self._chambers.read(time, np.full_like(values, np.nan) if beyond else values)
        if changed is not None:
            self._estimator.changed(changed)
        asked = np.abs(self._chambers.sent(round(time / CONTROL_PERIOD)))
        filled = asked > _FILLED * limb.pneumatics.pressure_limit
        empty = bool(np.any(filled & (np.abs(values) < TOO_SMALL * asked)))
        self._supervisor.held(time, float(np.abs(values).max()), not (beyond or empty))

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
            ValueError: another shape, or no time of the plan, or the covariance is none.
        """
        self._check(time)
        limb, angles, place = self.plan.limb, np.asarray(bend_angle), np.asarray(tip)
        # Of another unit, or nothing: not seen.
        angles = np.where(impossible(limb, "bend angles", angles), np.nan, angles)
        place = np.where(impossible(limb, "tips", place), np.nan, place)
        self._estimator.measure(time, angles, place, covariance)

    def command(self, time: float) -> Array:
        """Return the command (M,) [Pa] that takes effect at an instant [s] and holds for 50 ms.

        It keeps the limb's pressure and slew limits. To be asked for ahead of the instant, in
        order; asked for again, it is computed again.

        Raises:
            ValueError: no time of the plan.
        """
        self._check(time)
        self._newest = time
        k = round(time / CONTROL_PERIOD)
        instant = k * CONTROL_PERIOD
        supervisor = self._supervisor
        if instant <= self._chambers.newest - CONTROL_PERIOD:
            supervisor.late(instant, self._chambers.newest - instant)
        else:
            supervisor.in_time()
        planned, before = self._nominal.command(k), self._chambers.sent(k - 1)
        try:
            wanted, correction = self._corrections(k)
            sound = bool(np.isfinite(correction).all())
        except np.linalg.LinAlgError:
            sound = False
        if not sound:
            supervisor.stop(instant, "inconsistent", np.inf)
            wanted = correction = np.zeros_like(planned)
        air = self._nominal.model.air
        chambers = self._chambers.during(np.array([k * STEPS - 1]))[0]
        self._reaction.follow(planned, self.touch, chambers)
        allowed = self._reaction.allowed(planned + self._reaction.corrected(correction))
        command: Array = within_limits(allowed[None], air, CONTROL_PERIOD, before)[0][0]
        self._benefit.sent(k, command - planned, wanted)
        self._chambers.send(k, command)
        self._estimator.changed(instant)
        return command

    def _corrections(self, k: int) -> tuple[Array, Array]:
        """Return the correction (M,) [Pa] that is wanted in a control period, and what is sent."""
        instant, nothing = k * CONTROL_PERIOD, np.zeros(self._nominal.model.inputs)
        # Matrices of some ten rows: more threads only get into other processes' way.
        with _THREADS.limit(limits=1, user_api="blas"):
            known = self._estimator.at(instant)
            self._feel()
            age = instant - self._estimator.newest
            share = self._supervisor.advance(instant, age, known.strange)
            if share <= 0.0:
                return nothing, nothing
            wanted = self._horizon.solve(k, known)
            seen = round(self._estimator.newest / CONTROL_PERIOD)
            shown = self._estimator.at(seen * CONTROL_PERIOD)
            self._benefit.see(seen, self._estimator.gap(shown, seen))
            part = share * self._benefit.share * wanted
            return wanted, self._supervisor.calmed(instant, part)

    def _feel(self) -> None:
        """Look at what the newest picture says of a touch, if it is known what chambers held."""
        time = self._estimator.newest
        unheard = _UNHEARD < time - self._chambers.newest < np.inf
        if np.isfinite(time) and time > self._sense.newest.time and not unheard:
            self._sense.feel(time, self._nominal, self._estimator.at(time))

    def allowed(self, command: Array) -> Array:
        """Return the command (M,) [Pa] that the reaction to a touch makes of one; any thread."""
        return self._reaction.allowed(command)

    def coming(self) -> tuple[int, Array]:
        """Return the control period of the newest command, and corrections (W, M) [Pa] from it on.

        Those after the first are what would follow if nothing new were seen.
        """
        first, corrections = self._horizon.solution
        calmed = self._supervisor.calmed_ahead(self.share * corrections)
        corrections = self._reaction.mixed(calmed)
        planned = self._nominal.commands[self._nominal.periods(first + np.arange(_SOON))]
        for ahead, each in enumerate(planned):
            corrections[ahead] = self._reaction.allowed(each + corrections[ahead]) - each
        return first, corrections

    def sent(self, time: float, command: ArrayLike) -> None:
        """Tell that another command (M,) [Pa] was sent for an instant [s] than was asked for."""
        self._check(time)
        k, values = round(time / CONTROL_PERIOD), np.asarray(command, dtype=float)
        if values.shape != self._nominal.command(k).shape or not np.isfinite(values).all():
            raise ValueError(f"expected a command of one pressure a segment, got {values.tolist()}")
        self._chambers.send(k, values)
        self._estimator.changed(k * CONTROL_PERIOD)

    def late(self, time: float, by: float) -> None:
        """Tell that the command of an instant [s] could not be sent in time, and how late [s]."""
        self._check(time)
        self._supervisor.late(time, by)

    def estimate(self, time: float) -> Estimate:
        """Return the estimate of the limb at an instant [s], past or to come."""
        self._check(time)
        with _THREADS.limit(limits=1, user_api="blas"):
            return self._estimator.estimate(time)

    def _check(self, time: float) -> None:
        if not abs(time) < _LONGEST or time > self._newest + _AHEAD:
            raise ValueError(
                f"the instant {time:.6g} is none of the plan, whose newest command is of "
                f"{self._newest:.6g} s: give seconds since its first setpoint"
            )
