"""Messages that ask for a motion, checked and turned into requests to the planner."""

from __future__ import annotations

import threading
import uuid
from dataclasses import dataclass, field

import numpy as np
from nav_msgs.msg import Path as PathMessage
from numpy.typing import NDArray

from der_msgs.msg import MotionCommand
from der_planner.limb import HEAVIEST, Limb
from der_planner.methods import LEARNED
from der_planner.nodes.planner_parameters import PlannerOptions
from der_planner.planning import Motion, choose_method
from der_planner.planning.motions import DEFAULT_AMPLITUDE, DEFAULT_CYCLES, DEFAULT_PERIOD
from der_planner.planning.plan_file import learned_plan
from der_planner.planning.result import Plan
from limb_interfaces import topics
from limb_interfaces.stamps import NANOSECONDS, nanoseconds

Array = NDArray[np.float64]

OLDEST_STAMP = 10
"""A start further back than this [s] is a mistake; a shorter delay is travel and typing."""
FURTHEST_STAMP = 600
"""A start that lies further ahead than this [s] is a mistake: another clock, or another epoch."""


@dataclass
class Request:
    """One motion to plan, and whether it is still wanted.

    `limb` is mounted as asked for and carries the payload; a plan that was learned is played as it
    is.
    """

    plan_id: str
    limb: Limb
    motion: Motion
    model: str
    method: str
    start: int
    learned: Plan | None = None
    feedback: bool = False
    cancelled: threading.Event = field(default_factory=threading.Event)


def new_plan_id() -> str:
    """Return a name for a plan that was given none."""
    return uuid.uuid4().hex[:8]


def loaded(limb: Limb, payload: float, at: float) -> Limb:
    """Return the limb with a payload [kg] at an arc length [m]; 0 is the tip.

    Raises:
        LimbError: the payload is negative, or its place is not on the limb.
    """
    return limb.carrying(payload, at or None)


def start_of(stamp: int, now: int) -> int:
    """Check the instant at which a motion is to start.

    Args:
        stamp: [ns] ROS time; 0: as soon as possible.
        now: [ns] ROS time.

    Raises:
        ValueError: it lies too far back or ahead to be meant; says how far.
    """
    if stamp == 0:
        return 0
    ahead = (stamp - now) / NANOSECONDS
    if -OLDEST_STAMP <= ahead <= FURTHEST_STAMP:
        return stamp
    where = f"{ahead:.0f} s ahead" if ahead > 0 else f"{-ahead:.0f} s ago"
    raise ValueError(
        f"the motion is stamped to start {where}: the stamp may lie {OLDEST_STAMP} s back to "
        f"{FURTHEST_STAMP} s ahead, and 0 starts as soon as the plan is ready"
    )


def from_command(message: MotionCommand, options: PlannerOptions, now: int) -> Request:
    """Return what a command asks for; its plan id is the message's.

    Raises:
        ValueError: a field has a value that cannot be planned; names it.
    """
    start = start_of(nanoseconds(message.header.stamp), now)
    limb = _asked_for(message, options)
    if message.path and (message.motion or message.method == LEARNED):
        raise ValueError(
            "the command has a path, and a motion or a learned plan beside it: give one of them"
        )
    if message.method == LEARNED:
        return _from_learned(message, limb, options, start)
    model = message.model or options.model
    motion = _drawn(message, options) if message.path else _named(message, options)
    method = choose_method(model, message.method or options.method)
    feedback = _corrected(message, model, options)
    return Request(message.plan_id, limb, motion, model, method, start, feedback=feedback)


def _named(message: MotionCommand, options: PlannerOptions) -> Motion:
    return Motion.named(
        message.motion,
        amplitude=message.amplitude or DEFAULT_AMPLITUDE,
        period=message.period or DEFAULT_PERIOD,
        cycles=message.cycles or DEFAULT_CYCLES,
        branch=options.branch,
    )


def _drawn(message: MotionCommand, options: PlannerOptions) -> Motion:
    tip = np.array([(point.x, point.y) for point in message.path])
    return _along_path(None, tip, options, message.nearest_path or options.nearest_path)


def _along_path(time: Array | None, tip: Array, options: PlannerOptions, nearest: bool) -> Motion:
    return Motion.from_tip_path(
        time, tip, branch=options.branch, limits=options.limits, nearest=nearest
    )


def _from_learned(
    message: MotionCommand, limb: Limb, options: PlannerOptions, start: int
) -> Request:
    """Return the learned plan whose name stands in place of the motion's."""
    plan = learned_plan(options.learned_plans, message.motion, limb)
    motion = Motion(plan.motion, plan.amplitude, plan.period, plan.cycles)
    feedback = _corrected(message, plan.model, options)
    return Request(message.plan_id, plan.limb, motion, plan.model, LEARNED, start, plan, feedback)


def _asked_for(message: MotionCommand, options: PlannerOptions) -> Limb:
    """Return the limb mounted and loaded as a command says."""
    limb = options.limb.mounted(message.mounting) if message.mounting else options.limb
    if message.payload < 0 or message.payload > HEAVIEST:
        raise ValueError(f"the payload is {message.payload} kg: give 0 to {HEAVIEST:g} kg")
    carried = message.payload, message.payload_at
    if message.payload == 0:
        carried = options.payload, options.payload_at
    return loaded(limb, *carried)


def _corrected(message: MotionCommand, model: str, options: PlannerOptions) -> bool:
    """Tell whether a plan of a model is to be corrected while it is played."""
    if message.feedback and model != "der":
        raise ValueError(
            f"feedback corrects plans of the rod, not of the model {model}: ask for der"
        )
    return message.feedback or (options.feedback and model == "der")


def from_path(message: PathMessage, plan_id: str, options: PlannerOptions, now: int) -> Request:
    """Return what a path asks for.

    Raises:
        ValueError: the path is in another frame, too short, or cannot be timed.
    """
    frame = message.header.frame_id
    if frame not in ("", topics.BASE_FRAME):
        raise ValueError(f"the path is in frame '{frame}': send it in '{topics.BASE_FRAME}'")
    tip = np.array([(p.pose.position.x, p.pose.position.y) for p in message.poses])
    stamps = [nanoseconds(pose.header.stamp) for pose in message.poses]
    time = (np.array(stamps) - stamps[0]) * 1e-9 if any(stamps) else None
    motion = _along_path(time, tip.reshape(-1, 2), options, options.nearest_path)
    start = start_of(nanoseconds(message.header.stamp), now)
    limb = loaded(options.limb, options.payload, options.payload_at)
    method = choose_method(options.model, options.method)
    feedback = options.feedback and options.model == "der"
    return Request(plan_id, limb, motion, options.model, method, start, feedback=feedback)
