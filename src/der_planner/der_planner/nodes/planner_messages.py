"""What the planner publishes of a schedule: the whole plan, one setpoint, one tip reference."""

from __future__ import annotations

from geometry_msgs.msg import Point, PointStamped

from der_msgs.msg import PressurePlan, PressureSetpoint
from der_planner.planning.streaming import Schedule
from limb_interfaces import topics
from limb_interfaces.stamps import stamp_from_nanoseconds


def plan_message(schedule: Schedule) -> PressurePlan:
    """Return the whole plan, stamped with its first setpoint's instant."""
    result = schedule.plan
    payload, place = result.limb.payload
    message = PressurePlan(
        plan_id=schedule.plan_id, motion=result.motion, model=result.model,
        method=result.method, amplitude=result.amplitude, period=result.period,
        cycles=result.cycles, limb=result.limb.name, gravity=result.limb.gravity,
        payload=payload, payload_at=place,
        segment_count=result.limb.segment_count,
        time=result.time.tolist(),
        differential_pressure=result.differential_pressure.ravel().tolist(),
        tip_reference=result.tip_reference.ravel().tolist(),
        tip_predicted=result.tip_predicted.ravel().tolist(),
        solve_time=result.solve_time, predicted_error=result.predicted_error,
    )  # fmt: skip
    message.header.stamp = stamp_from_nanoseconds(schedule.start)
    message.header.frame_id = topics.BASE_FRAME
    return message


def setpoint_message(schedule: Schedule, index: int) -> PressureSetpoint:
    """Return one setpoint, stamped with the instant at which it takes effect."""
    message = PressureSetpoint(plan_id=schedule.plan_id, index=index)
    message.header.stamp = stamp_from_nanoseconds(schedule.stamp(index))
    message.header.frame_id = topics.BASE_FRAME
    message.differential_pressure = schedule.plan.differential_pressure[index].tolist()
    return message


def reference_message(schedule: Schedule, index: int) -> PointStamped:
    """Return where the tip should be at a setpoint's instant [m]."""
    x, y = schedule.plan.tip_reference[index]
    message = PointStamped(point=Point(x=float(x), y=float(y)))
    message.header.stamp = stamp_from_nanoseconds(schedule.stamp(index))
    message.header.frame_id = topics.BASE_FRAME
    return message
