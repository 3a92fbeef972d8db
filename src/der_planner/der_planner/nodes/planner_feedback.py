"""Feedback on the graph: revises setpoints that are still to come, whenever something is seen.

A thread of its own works on what came since, in the order in which it came, and revises the next
setpoint that can still be reached. The streamer goes on sending every setpoint a lead before its
stamp, with the newest corrections there are for it; it never waits for this thread.
"""

from __future__ import annotations

import math
import threading
import time as clock
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from std_srvs.srv import Trigger

from der_msgs.msg import LimbState, PressureState
from der_planner.arrays import Array
from der_planner.control.feedback import Feedback
from der_planner.estimation.force import untouched
from der_planner.limb import Limb
from der_planner.nodes.planner_topics import PlannerPublishers
from der_planner.planning import METHODS, Motion, plan
from der_planner.planning.streaming import GRID, Schedule
from limb_interfaces.clocks import LARGEST
from limb_interfaces.diagnostics import TOUCHED
from limb_interfaces.stamps import NANOSECONDS, nanoseconds

_TRAVEL = 0.015
"""A revision is sent at least this long [s] before its stamp, so that the driver has it in time."""
_LONGEST_AHEAD = 0.15
"""The setpoint that is revised is at most this far ahead [s], however slow this machine is."""
_SLOWER = 1.5
"""A solution may take this many times as long as the last ones took."""
_SMALLEST_BEND = 1e-3
"""A bend angle's standard deviation counts as at least this [rad]: trackers tell corner noise."""
_SMALLEST_TIP = 1e-4
"""The tip's standard deviation counts as at least this [m], for the same reason."""
_STALE = 10
"""Corrections of an older solution are used in full for this many setpoints; then they fade."""


class _Corrected:
    """A schedule with its feedback, and what was sent of it.

    Args:
        schedule: what is played.
        feedback: of its plan.
        left: the schedule that gives way to this one; None: this one begins at rest.
        earlier: feedback of the schedule before.
    """

    def __init__(
        self,
        schedule: Schedule,
        feedback: Feedback,
        left: _Corrected | None,
        earlier: Feedback | None,
    ) -> None:
        self.schedule, self.feedback = schedule, feedback
        self._left, self._earlier = left, earlier
        self.coming: tuple[int, Array] = feedback.coming()
        self.revisions: dict[int, int] = {}
        self.warned = 0
        self.touched = self.felt = -math.inf
        self.touching = self.vented = False
        self.payload = feedback.touch.payload

    def time_of(self, stamp: int) -> float:
        """Return an instant [ns] in the plan's seconds."""
        return (stamp - self.schedule.start) / NANOSECONDS

    def begins(self, index: int) -> bool:
        """Tell whether setpoint ``index`` is one of this schedule, which then has taken over."""
        if not 0 <= index < self.schedule.count:
            return False
        if self._left is not None:
            left, self._left = self._left, None
            self.feedback.take_over(left.feedback, left.time_of(self.schedule.start))
        elif self._earlier is not None:
            self.feedback.remember(self._earlier)
        self._earlier = None
        return True

    def tell(self, told: list[Callable[[_Corrected], None]], alone: bool) -> None:
        """Take what came, or pass it on to the schedule that has not given way yet.

        Args:
            told: in the order in which it came.
            alone: that schedule is corrected no more.
        """
        if self._left is not None and not alone:
            return  # that schedule is told itself
        receiver = self._left or self
        for item in told:
            item(receiver)

    def pressures(self, index: int) -> Array:
        """Return the pressures (M,) [Pa] of a setpoint with the newest correction for it.

        However old that is, a reaction to a touch holds.
        """
        planned = self.schedule.plan.differential_pressure[index]
        limit = self.schedule.plan.limb.pneumatics.pressure_limit
        return np.clip(self.feedback.allowed(planned + self._correction(index)), -limit, limit)

    def _correction(self, index: int) -> Array:
        if self._left is not None:
            return self._left._correction(
                index + (self.schedule.start - self._left.schedule.start) // GRID
            )
        first, corrections = self.coming
        ahead = index - first
        if ahead < 0:
            return np.zeros_like(corrections[0])
        fade = max(0.0, 1.0 - max(0, ahead - _STALE) / _STALE)
        return fade * corrections[min(ahead, len(corrections) - 1)]


class Corrector:
    """Corrects the schedules that are played; see the module.

    Args:
        output: publishes revised setpoints and estimates.
        warn: says why feedback was taken back or slowed.
        now: present ROS time [ns].
        vent: asks the driver to vent the limb, where a touch asks for it.
    """

    def __init__(
        self,
        output: PlannerPublishers,
        warn: Callable[[str], None],
        now: Callable[[], int],
        vent: Callable[[Trigger.Request], object],
    ) -> None:
        self._output, self._warn, self._now, self._vent = output, warn, now, vent
        self._wake = threading.Condition()
        self._inbox: deque[Callable[[_Corrected], None]] = deque(maxlen=200)
        self._open: list[_Corrected] = []
        self._last: Feedback | None = None
        self._seen = self._closed = self._was_ahead = False
        self._took = 0.01
        self._thread = threading.Thread(target=self._run, name="feedback", daemon=True)
        self._thread.start()

    @property
    def reason(self) -> str:
        """Why feedback is out for the plan in force; empty while it acts, or if there is none."""
        with self._wake:
            return self._open[-1].feedback.reason if self._open else ""

    def follow(self, schedule: Schedule, feedback: Feedback) -> None:
        """Correct a schedule from now on."""
        with self._wake:
            goes_on = self._open and schedule.plan.reference.start is not None
            left = self._open[-1] if goes_on else None
            self._open.append(_Corrected(schedule, feedback, left, self._last))
            self._last = feedback
            self._wake.notify_all()

    def forget(self, schedule: Schedule) -> str:
        """Correct a schedule no more; return why feedback had the limb vented, if it had."""
        with self._wake:
            ended = next((each for each in self._open if each.schedule is schedule), None)
            if ended is None:
                return ""
            self._open.remove(ended)
        touch = ended.feedback.touch
        if ended.touching:
            over = untouched(touch.time, touch.bend_angles)
            said = "the motion has ended: touch is felt in motions with feedback alone"
            self._output.contact(schedule, replace(over, said=said))
        return f"{TOUCHED} (the reaction is to vent): {touch.said}" if ended.vented else ""

    def pressures(self, schedule: Schedule, index: int) -> Array:
        """Return the pressures (M,) [Pa] with which a setpoint is first sent."""
        with self._wake:
            found = next((each for each in self._open if each.schedule is schedule), None)
        if found is None:
            return schedule.plan.differential_pressure[index]
        pressures = found.pressures(index)
        self._post(lambda each: self._was_sent(each, schedule, index, pressures))
        return pressures

    def add_pressures(self, state: PressureState) -> None:
        """Take in what the chambers hold."""
        measured = np.array(state.measured_differential)
        if not len(measured) or not np.isfinite(state.telemetry_age):
            return
        stamp = nanoseconds(state.header.stamp) - round(state.telemetry_age * NANOSECONDS)
        self._post(lambda each: each.feedback.pressures(each.time_of(stamp), measured))

    def add_state(self, state: LimbState) -> None:
        """Take in what a picture showed."""
        if not state.valid:
            return
        stamp = nanoseconds(state.header.stamp)
        ahead = (stamp - self._now()) / NANOSECONDS
        if ahead > LARGEST:
            if not self._was_ahead:
                self._warn(
                    f"pictures come from {1e3 * ahead:.0f} ms in the future and are left out: the "
                    "clock of their computer is off (docs/guide/two_computers.md)"
                )
            self._was_ahead = True
            return
        bend, tip = np.array(state.bend_angle), np.array([state.tip.x, state.tip.y])
        size, told = len(bend), np.array(state.bend_angle_sigma)
        sigma = np.full(size, _SMALLEST_BEND)
        if len(told) == size:
            sigma = np.maximum(np.nan_to_num(told), sigma)
        spread = np.zeros((size + 2, size + 2))
        spread[:size, :size] = np.diag(sigma**2)
        covariance = np.nan_to_num(np.array(state.tip_covariance)).reshape(2, 2)
        spread[size:, size:] = covariance + _SMALLEST_TIP**2 * np.eye(2)
        self._post(lambda each: each.feedback.measure(each.time_of(stamp), bend, tip, spread))
        with self._wake:
            self._seen = True
            self._wake.notify_all()

    def close(self) -> None:
        """End the thread."""
        with self._wake:
            self._closed = True
            self._wake.notify_all()
        self._thread.join(timeout=2.0)

    def _post(self, item: Callable[[_Corrected], None]) -> None:
        with self._wake:
            if self._open:
                self._inbox.append(item)

    @staticmethod
    def _was_sent(each: _Corrected, schedule: Schedule, index: int, pressures: Array) -> None:
        if each.schedule is schedule and index not in each.revisions:
            each.feedback.sent(index * GRID / NANOSECONDS, pressures)

    def _run(self) -> None:
        while True:
            with self._wake:
                if not self._seen:
                    self._wake.wait(GRID / NANOSECONDS if self._open else None)
                if self._closed:
                    return
                self._seen = False
                told = list(self._inbox)
                self._inbox.clear()
                following = list(self._open)
            for each in following:
                self._correct(each, told, len(following) == 1)

    def _correct(
        self, each: _Corrected, told: list[Callable[[_Corrected], None]], alone: bool
    ) -> None:
        try:
            each.tell(told, alone)
            self._revise(each)
        except Exception as error:
            # Whatever goes wrong here, the plan goes on without feedback.
            self.forget(each.schedule)
            text = f"{type(error).__name__}: {error}"
            self._warn(f"plan {each.schedule.plan_id}: feedback failed, {text}")

    def _revise(self, each: _Corrected) -> None:
        """Revise the next setpoint of a schedule that can still be reached."""
        schedule, feedback = each.schedule, each.feedback
        begin, now = clock.perf_counter(), self._now()
        ahead = min(_TRAVEL + _SLOWER * self._took, _LONGEST_AHEAD)
        index = -(-(now + round(ahead * NANOSECONDS) - schedule.start) // GRID)
        if self._replaced(each, index) or not each.begins(index):
            return
        planned = schedule.plan.differential_pressure[index]
        pressures = feedback.command(index * GRID / NANOSECONDS)
        took = clock.perf_counter() - begin
        self._took += 0.1 * (took - self._took)
        left = (schedule.stamp(index) - self._now()) / NANOSECONDS
        if left > 0:
            revision = each.revisions[index] = each.revisions.get(index, 0) + 1
            each.revisions.pop(index - 100, None)
            self._output.setpoint(schedule, index, pressures, revision)
        else:
            feedback.late(index * GRID / NANOSECONDS, -left)
        each.coming = feedback.coming()
        for warned in feedback.warnings[each.warned :]:
            text = f"plan {schedule.plan_id}, {warned.time:.2f} s: feedback, "
            self._warn(f"{text}{warned.name}: {warned.message}")
        each.warned = len(feedback.warnings)
        self._react(each)
        instant = max(now, schedule.start)
        estimate = feedback.estimate(each.time_of(instant))
        self._output.estimate(
            schedule, instant, estimate, correction=(pressures - planned).tolist(),
            share=feedback.share, reason=feedback.reason, solve_time=took,
        )  # fmt: skip

    def _react(self, each: _Corrected) -> None:
        """Say when a touch begins and when it ends, and vent the limb if that is set."""
        touch = each.feedback.touch
        if touch.time > each.felt:
            each.felt = touch.time
            self._output.contact(each.schedule, touch)
        if touch.touched and touch.since > each.touched:
            each.touched = touch.since
            text = f"plan {each.schedule.plan_id}, {touch.since:.2f} s: something touches the limb"
            self._warn(f"{text}: {touch.said}")
        elif each.touching and not touch.touched:
            self._warn(f"plan {each.schedule.plan_id}, {touch.time:.2f} s: nothing touches it now")
        each.touching = touch.touched
        if touch.payload != each.payload:
            each.payload = touch.payload
            self._warn(
                f"plan {each.schedule.plan_id}: the payload has changed: {touch.said or 'none'}"
            )
        if each.feedback.vents and not each.vented:
            each.vented = True
            self._vent(Trigger.Request())

    def _replaced(self, each: _Corrected, index: int) -> bool:
        """Tell whether another schedule has taken over by a setpoint's instant."""
        stamp = each.schedule.stamp(index)
        with self._wake:
            later = self._open[self._open.index(each) + 1 :] if each in self._open else []
        return any(other.schedule.start <= stamp for other in later)


def warm_up(limb: Limb, nodes: int) -> None:
    """Compile every kernel that planning and feedback call, so that no plan has to wait for it."""
    quick = Motion.named("asynchronous", amplitude=0.1, period=2.0, cycles=1)
    for model, methods in METHODS.items():
        for method in methods:
            found = plan(limb, quick, model, method, nodes=nodes)
    feedback = Feedback(found)
    feedback.measure(0.0, found.bend_angles[0], found.tip_predicted[0])
    feedback.command(0.0)
