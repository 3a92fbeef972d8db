"""What the planner publishes, what it says of itself, and what it concludes of the driver."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import Point, PointStamped, Vector3
from rclpy.node import Node
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from der_msgs.msg import LimbContact, LimbEstimate, PressurePlan, PressureSetpoint, PressureState
from der_planner.arrays import Array, interpolate
from der_planner.estimation.force import Touch
from der_planner.estimation.knowledge import Estimate
from der_planner.planning import Plan
from der_planner.planning.streaming import GRID, Ending, Schedule
from limb_interfaces import qos, topics
from limb_interfaces.diagnostics import Health
from limb_interfaces.stamps import NANOSECONDS, nanoseconds, stamp_from_nanoseconds

REFERENCE = ColorRGBA(r=0.1, g=0.6, b=0.2, a=1.0)
PREDICTED = ColorRGBA(r=0.9, g=0.5, b=0.1, a=1.0)
ESTIMATED = ColorRGBA(r=0.1, g=0.4, b=0.9, a=0.7)
LIMB = ColorRGBA(r=0.1, g=0.6, b=0.2, a=0.5)
TOUCH = ColorRGBA(r=0.9, g=0.1, b=0.1, a=1.0)
_METRES_PER_NEWTON = 0.1
"""Length of the arrow that is drawn for a force."""


# What is published -------------------------------------------------------------------------------


class PlannerPublishers:
    """Publishes the plan that is being played, its setpoints, references, estimates, markers."""

    def __init__(self, node: Node) -> None:
        self._clock = node.get_clock()
        self._plans = node.create_publisher(PressurePlan, topics.PLAN, qos.LATCHED)
        self._setpoints = node.create_publisher(
            PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINT_STREAM
        )
        self._references = node.create_publisher(PointStamped, topics.TIP_REFERENCE, qos.STATES)
        self._markers = node.create_publisher(MarkerArray, topics.SHAPE_MARKERS, qos.STATES)
        self._estimates = node.create_publisher(LimbEstimate, topics.ESTIMATE, qos.STATES)
        self._contacts = node.create_publisher(LimbContact, topics.CONTACT, qos.STATES)

    def plan(self, schedule: Schedule) -> None:
        """Publish a whole plan, stamped with its first setpoint, and both its tip paths."""
        result = schedule.plan
        payload, place = result.limb.payload
        self._plans.publish(
            PressurePlan(
                header=_header(schedule.start), plan_id=schedule.plan_id,
                motion=result.motion, model=result.model, method=result.method,
                amplitude=result.amplitude, period=result.period, cycles=result.cycles,
                limb=result.limb.name, gravity=result.limb.gravity,
                payload=payload, payload_at=place, segment_count=result.limb.segment_count,
                time=result.time.tolist(),
                differential_pressure=result.differential_pressure.ravel().tolist(),
                tip_reference=result.tip_reference.ravel().tolist(),
                tip_predicted=result.tip_predicted.ravel().tolist(),
                solve_time=result.solve_time, predicted_error=result.predicted_error,
            )
        )  # fmt: skip
        self._draw(
            self._line("reference_path", result.tip_reference, REFERENCE, 0.001),
            self._line("predicted_path", result.tip_predicted, PREDICTED, 0.0007),
        )

    def setpoint(self, schedule: Schedule, index: int, pressures: Array, revision: int = 0) -> None:
        """Publish one setpoint (M,) [Pa], stamped with the instant at which it takes effect."""
        message = PressureSetpoint(plan_id=schedule.plan_id, index=index, revision=revision)
        message.header = _header(schedule.stamp(index))
        message.differential_pressure = pressures.tolist()
        self._setpoints.publish(message)

    def reference(self, schedule: Schedule, index: int) -> None:
        """Publish where the tip should be at a setpoint's instant."""
        header, tip = _header(schedule.stamp(index)), schedule.plan.tip_reference[index]
        self._references.publish(PointStamped(header=header, point=_points([tip])[0]))

    def estimate(
        self, schedule: Schedule, instant: int, estimate: Estimate, **about: object
    ) -> None:
        """Publish what feedback knows of the limb at an instant [ns], and what it did about it.

        Args:
            schedule: that is played.
            instant: of the estimate.
            estimate: of the limb.
            about: fields of the message: correction (M,) [Pa], share, reason, solve_time [s].
        """
        inputs = len(estimate.bend_angle)
        sigma = np.split(estimate.deviation, np.arange(1, 5) * inputs)
        curve = schedule.plan.body.kinematics.curve(estimate.bend_angle)
        self._estimates.publish(
            LimbEstimate(
                header=_header(instant), plan_id=schedule.plan_id,
                tip=_points([estimate.tip])[0], tip_covariance=estimate.tip_covariance.ravel(),
                bend_angle=estimate.bend_angle.tolist(), bend_angle_sigma=sigma[0].tolist(),
                bend_rate=estimate.bend_rate.tolist(),
                missing_pressure=estimate.missing_pressure.tolist(),
                missing_pressure_sigma=sigma[2].tolist(),
                gain_error=estimate.gain_error.tolist(), gain_error_sigma=sigma[3].tolist(),
                tip_offset=estimate.tip_offset, curve=_points(curve), age=min(estimate.age, 1e9),
                **about,
            )
        )  # fmt: skip
        self._draw(self._line("estimate", curve, ESTIMATED, 0.004))

    def contact(self, schedule: Schedule, touch: Touch) -> None:
        """Publish what touches the limb, and draw its force where both can be told.

        Args:
            schedule: that is played.
            touch: as it is known at the newest picture.
        """
        told = LimbContact(
            header=_header(schedule.start + round(touch.time * NANOSECONDS)),
            plan_id=schedule.plan_id, touched=touch.touched, distance=touch.distance,
            arc_length=touch.place, arc_length_sigma=touch.place_deviation,
            force_covariance=touch.force_covariance.ravel(), pressure=touch.pressure.tolist(),
            said=touch.said,
        )  # fmt: skip
        told.force = Vector3(x=float(touch.force[0]), y=float(touch.force[1]))
        told.point = Point(x=math.nan, y=math.nan)
        arrow = self._line("contact", np.empty((0, 2)), TOUCH, 0.002)
        arrow.type, arrow.action = Marker.ARROW, Marker.DELETE
        if touch.touched:
            told.since = stamp_from_nanoseconds(schedule.start + round(touch.since * NANOSECONDS))
            curve = schedule.plan.body.kinematics.curve(touch.bend_angles)
            along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1)))
            ends = interpolate(np.full(1, touch.place), along, curve)
            ends = np.concatenate([ends - _METRES_PER_NEWTON * touch.force, ends])
            told.point = _points(ends)[1]
            if np.isfinite(ends).all():
                arrow.action, arrow.points = Marker.ADD, _points(ends)
                arrow.scale.y = 2.0 * arrow.scale.x
        self._contacts.publish(told)
        self._draw(arrow)

    def reference_limb(self, schedule: Schedule, index: int, lead: int) -> None:
        """Draw the reference limb as it should be now, ``lead`` [ns] before setpoint ``index``."""
        curve = schedule.plan.curve(max(0, index - 1 - lead // GRID))
        self._draw(self._line("limb", curve, LIMB, 0.006))

    def _draw(self, *markers: Marker) -> None:
        self._markers.publish(MarkerArray(markers=list(markers)))

    def _line(self, name: str, points: Array, color: ColorRGBA, width: float) -> Marker:
        marker = Marker(ns=f"planner/{name}", id=0, type=Marker.LINE_STRIP, action=Marker.ADD)
        marker.header = Header(stamp=self._clock.now().to_msg(), frame_id=topics.BASE_FRAME)
        marker.pose.orientation.w = 1.0
        marker.scale.x, marker.color, marker.points = width, color, _points(points)
        return marker


def _header(instant: int) -> Header:
    """Return the header of an instant [ns] in the limb's frame."""
    return Header(stamp=stamp_from_nanoseconds(instant), frame_id=topics.BASE_FRAME)


def _points(places: Array | Sequence[Array]) -> list[Point]:
    return [Point(x=float(x), y=float(y)) for x, y in places]


# What it says of itself --------------------------------------------------------------------------

_LEVELS = {
    "starting": "stale",
    **dict.fromkeys(("error", "fault", "lost"), "error"),
    **dict.fromkeys(("refused", "vented"), "warning"),
}
"""Levels of the diagnostics in states that say it all."""


class Status(NamedTuple):
    """The planner's state, the plan that it is about, and why.

    States: starting, idle, planning, streaming, done, refused, error, and the outcomes of a plan
    that the driver ended (vented, fault, lost).
    """

    state: str = "starting"
    plan_id: str = ""
    reason: str = ""

    def health(self, refusal: str, values: dict[str, object]) -> Health:
        """Return the diagnostics with values, after a refusal if there was one."""
        state, _, reason = self
        if state in _LEVELS:
            return Health(_LEVELS[state], f"{state}: {reason or 'kernels compile'}", values)
        if refusal:
            return Health("warning", f"{state}; refused {refusal}", values)
        warned = state == "streaming" and reason
        return Health("warning" if warned else "ok", reason or state, values)


def told_of(plan: Plan) -> dict[str, object]:
    """Return the figures of a plan that the diagnostics tell."""
    return {
        "predicted_error_m": f"{plan.predicted_error:.6f}",
        "pressure_margin_pa": f"{plan.pressure_margin:.0f}",
        "slew_margin_pa_per_s": f"{plan.slew_margin:.0f}",
        "solve_time_s": f"{plan.solve_time:.3f}",
    }


# The driver --------------------------------------------------------------------------------------

_NAMES = {
    getattr(PressureState, name): name
    for name in ("DISARMED", "ARMED", "TRACKING", "HOLDING", "VENTING", "FAULT")
}
_REMEDY = "arm the driver, then play the plan again"


class DriverWatch:
    """Keeps the driver's newest state; its methods may be called from any thread.

    A planner that has never heard a driver streams: the listener may be one that tells nothing of
    itself. From the first `pressure_state` on, a driver that is silent, disarmed or in fault gets
    nothing.

    Args:
        steady: returns the present time of a steady clock [s].
        timeout: [s] after which a driver that says nothing counts as dead.
    """

    def __init__(self, steady: Callable[[], float], timeout: float) -> None:
        self._steady, self._timeout = steady, timeout
        self._changed = threading.Condition()
        self._mode: int | None = None
        self._faults: list[str] = []
        self._heard = 0.0
        self._refused = self._counted = 0
        self._told_to_vent = False

    @property
    def mode(self) -> str:
        """Name of the driver's newest mode; empty before the first."""
        with self._changed:
            return "" if self._mode is None else _NAMES.get(self._mode, str(self._mode))

    def update(self, state: PressureState, begun: Sequence[str], asked: int = 0) -> Ending | None:
        """Keep a new state; return why everything must be stopped because of it, or None.

        The driver vents by itself only after HOLDING. A ramp down at the end of an earlier plan
        does not concern the next one.

        Args:
            state: from the driver.
            begun: ids of the plans whose first setpoint is due already.
            asked: when a motion was asked for last [ns]; what an older state says does not concern
                it, and comes late where this process was kept from running.
        """
        with self._changed:
            self._heard = self._steady()
            if nanoseconds(state.header.stamp) < asked:
                return None
            before, self._mode = self._mode, int(state.mode)
            self._faults, self._refused = list(state.faults), int(state.setpoints_refused)
            begins = self._mode == PressureState.VENTING and before != self._mode
            if begins:
                self._told_to_vent = before != PressureState.HOLDING
            self._changed.notify_all()
        if begins and state.plan_id in begun:
            return Ending("vented", f"the driver vents the limb: {_REMEDY}")
        if begins and before in (PressureState.ARMED, PressureState.TRACKING):
            return Ending("vented", f"the driver was told to vent, or lost its operator: {_REMEDY}")
        stopped = self._mode in (PressureState.DISARMED, PressureState.FAULT)
        return self.obstacle() if stopped else None

    def newly_refused(self) -> int:
        """Return how many setpoints the driver has refused since this was asked last."""
        with self._changed:
            before, self._counted = self._counted, self._refused
            return max(self._counted - before, 0)

    def obstacle(self) -> Ending | None:
        """Return why the driver takes no setpoints now; None if it does, or was never heard."""
        with self._changed:
            mode, age = self._mode, self._steady() - self._heard
            if mode is None:
                return None
            if age > self._timeout:
                return Ending(
                    "lost",
                    f"the driver has said nothing for {age:.1f} s: see whether it runs and the "
                    f"limb is vented, then {_REMEDY}",
                )
            if mode == PressureState.FAULT:
                faults = "; ".join(self._faults) or "no reason given"
                return Ending(
                    "fault", f"the driver is in FAULT ({faults}): remove the cause, {_REMEDY}"
                )
            if mode == PressureState.DISARMED:
                return Ending("vented", f"the driver is DISARMED: {_REMEDY}")
            if mode == PressureState.VENTING and self._told_to_vent:
                return Ending("vented", f"the driver is VENTING: wait, {_REMEDY}")
        return None

    def wait(self, seconds: float) -> Ending | None:
        """Wait until the driver takes setpoints, at most so long [s]; return what forbids it."""
        end = self._steady() + seconds
        with self._changed:
            while (found := self.obstacle()) is not None and (left := end - self._steady()) > 0:
                self._changed.wait(left)
        return found
