"""What the planner publishes of a schedule: the whole plan, one setpoint, one tip reference."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, PointStamped
from numpy.typing import NDArray

from der_msgs.msg import LimbEstimate, PressurePlan, PressureSetpoint
from der_planner.control.knowledge import Estimate
from der_planner.planning.streaming import Schedule
from limb_interfaces import topics
from limb_interfaces.stamps import stamp_from_nanoseconds

Array = NDArray[np.float64]


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


def setpoint_message(
    schedule: Schedule, index: int, pressures: Array, revision: int = 0
) -> PressureSetpoint:
    """Return one setpoint (M,) [Pa], stamped with the instant at which it takes effect."""
    message = PressureSetpoint(plan_id=schedule.plan_id, index=index, revision=revision)
    message.header.stamp = stamp_from_nanoseconds(schedule.stamp(index))
    message.header.frame_id = topics.BASE_FRAME
    message.differential_pressure = pressures.tolist()
    return message


def reference_message(schedule: Schedule, index: int) -> PointStamped:
    """Return where the tip should be at a setpoint's instant [m]."""
    x, y = schedule.plan.tip_reference[index]
    message = PointStamped(point=Point(x=float(x), y=float(y)))
    message.header.stamp = stamp_from_nanoseconds(schedule.stamp(index))
    message.header.frame_id = topics.BASE_FRAME
    return message


def estimate_message(schedule: Schedule, instant: int, estimate: Estimate) -> LimbEstimate:
    """Return the estimated state of the limb at an instant [ns]."""
    inputs = len(estimate.bend_angle)
    sigma = np.split(estimate.deviation, np.arange(1, 5) * inputs)
    x, y = estimate.tip
    message = LimbEstimate(
        plan_id=schedule.plan_id,
        tip=Point(x=float(x), y=float(y)),
        tip_covariance=estimate.tip_covariance.ravel(),
        bend_angle=estimate.bend_angle.tolist(),
        bend_angle_sigma=sigma[0].tolist(),
        bend_rate=estimate.bend_rate.tolist(),
        missing_pressure=estimate.missing_pressure.tolist(),
        missing_pressure_sigma=sigma[2].tolist(),
        gain_error=estimate.gain_error.tolist(),
        gain_error_sigma=sigma[3].tolist(),
        tip_offset=estimate.tip_offset,
        curve=[
            Point(x=float(a), y=float(b))
            for a, b in schedule.plan.kinematics.curve(estimate.bend_angle)
        ],
        age=min(estimate.age, 1e9),
    )
    message.header.stamp = stamp_from_nanoseconds(instant)
    message.header.frame_id = topics.BASE_FRAME
    return message
