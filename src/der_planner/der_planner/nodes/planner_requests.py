"""What is asked of the planner: its parameters, the messages that ask for a motion, its action."""

# ruff: noqa: RUF009 - `_parameter` returns a field

from __future__ import annotations

import dataclasses
import math
import threading
import uuid
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from nav_msgs.msg import Path as PathMessage
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from der_msgs.action import PlayMotion
from der_msgs.msg import LimbState, MotionCommand
from der_planner.arrays import Array, points_of
from der_planner.control.feedback import Feedback
from der_planner.control.reaction import KINDS, Kind
from der_planner.limb import HEAVIEST, Limb, Load
from der_planner.methods import LEARNED
from der_planner.planning import METHODS, Motion, Obstacles, PathLimits, choose_method
from der_planner.planning.motions import DEFAULT_AMPLITUDE, DEFAULT_CYCLES, DEFAULT_PERIOD
from der_planner.planning.plan_file import Plan, learned_plan
from der_planner.planning.streaming import GRID, Schedule
from der_planner.planning.workspace import BRANCHES
from limb_interfaces import topics
from limb_interfaces.parameters import ParameterError, declare
from limb_interfaces.stamps import NANOSECONDS, nanoseconds

OLDEST_STAMP = 10
"""A start further back than this [s] is a mistake; a shorter delay is travel and typing."""
FURTHEST_STAMP = 600
"""A start that lies further ahead than this [s] is a mistake: another clock, or another epoch."""


def _parameter(
    default: Any, text: str, least: float | None = None, most: float | None = None, **more: Any
) -> Any:
    """Return the field of a parameter of the same name, with what `declare` is told of it."""
    return field(default=default, metadata={"told": (text, least, most), **more})


@dataclass(frozen=True)
class PlannerOptions:
    """The node's parameters, checked: each field with a description, and what follows from others.

    `limb` is mounted as the parameters say, and does not carry the payload yet; `lead` is the lead
    time in ns; `limits` are those along a path; `in_the_way` is what the file of obstacles holds.
    """

    limb: Limb
    lead: int
    limits: PathLimits
    in_the_way: Obstacles | None
    limb_file: str = _parameter("", "limb file (YAML); empty: the default limb")
    mounting: str = _parameter(
        "", "horizontal, hanging, standing, sideways or degrees; empty: as in the limb file"
    )
    obstacles: str = _parameter(
        "", "file (YAML) of what is in the limb's way: motions into it are refused; empty: nothing"
    )
    learned_plans: str = _parameter(
        "", "folder of learned plans, which commands of the method 'learned' name"
    )
    payload: float = _parameter(
        0.0, "mass [kg] carried, if a command names none", 0.0, HEAVIEST, read_only=False
    )
    payload_at: float = _parameter(
        0.0, "where, along the limb from its clamp [m]; 0: the tip", 0.0, read_only=False
    )
    default_model: str = _parameter(
        "der", "model for paths and for commands that name none", choices=tuple(METHODS)
    )
    default_method: str = _parameter(
        "", "method where none is named; empty: the best", choices=("", *METHODS["der"])
    )
    nodes: int = _parameter(21, "nodes of the rod", 6, 201)
    lead_time: float = _parameter(
        0.2, "time between sending a setpoint and its stamp [s]", 0.05, 2.0
    )
    auto_start: bool = _parameter(True, "play a plan as soon as it is ready")
    branch: str = _parameter(
        "", "side of the fold that is taken; empty: the least pressure", choices=("", *BRANCHES)
    )
    path_speed: float = _parameter(0.03, "speed along a path without times [m/s]", 1e-3, 1.0)
    path_acceleration: float = _parameter(0.05, "acceleration along a path [m/s^2]", 1e-3, 10.0)
    nearest_path: bool = _parameter(
        False, "follow the nearest path in reach in place of one that leaves it", read_only=False
    )
    driver_timeout: float = _parameter(
        1.0, "silence of the driver [s] after which it counts as dead", 0.2, 60.0
    )
    feedback: bool = _parameter(False, "correct plans of the rod while they are played")
    reaction: Kind = _parameter(
        "yield", "what feedback does where something touches the limb", choices=KINDS
    )
    force_limit: float = _parameter(
        0.0, "force [N] that 'yield' allows; 0: none more than the plan's", 0.0, 100.0
    )

    def corrected(self, planned: Plan) -> Feedback:
        """Return feedback on a plan, with the reaction to a touch that is set."""
        return Feedback(planned, self.reaction, self.force_limit or None)

    def as_now(self, node: Node) -> PlannerOptions:
        """Return the parameters with what may be changed while the node runs as it is now."""
        changeable = ("nearest_path", "payload", "payload_at")
        now: dict[str, Any] = {name: node.get_parameter(name).value for name in changeable}
        return dataclasses.replace(self, **now)


def read_parameters(node: Node) -> PlannerOptions:
    """Declare and check the planner's parameters.

    Raises:
        ParameterError: a value is out of range; names it.
        LimbError: the limb file cannot be used.
        PlanningError: the file of obstacles cannot be used.
    """
    read: dict[str, Any] = {}
    for each in dataclasses.fields(PlannerOptions):
        if each.metadata:
            more = dict(each.metadata)
            read[each.name] = declare(node, each.name, each.default, *more.pop("told"), **more)
    if read["force_limit"] and read["reaction"] != "yield":
        raise ParameterError(
            f"parameter 'force_limit' is what the reaction yield allows, 'reaction' is "
            f"{read['reaction']}: leave one of them out"
        )
    limb = Limb.from_yaml(read["limb_file"]) if read["limb_file"] else Limb.default()
    for name in ("limb_file", "learned_plans"):  # as other processes find them
        read[name] = str(Path(read[name]).expanduser().resolve()) if read[name] else ""
    return PlannerOptions(
        limb=limb.loaded(Load(mounting=read["mounting"])),
        lead=round(NANOSECONDS * read["lead_time"]),
        limits=PathLimits(read["path_speed"], read["path_acceleration"]),
        in_the_way=Obstacles.from_yaml(read["obstacles"]) if read["obstacles"] else None,
        **read,
    )


# Messages that ask for a motion ------------------------------------------------------------------


@dataclass
class Request:
    """One motion to plan, and whether it is still wanted.

    `limb` is mounted as asked for and carries the payload; a plan that was learned is played as it
    is.
    `asked` is when it came [ns of ROS time]: no arming after that makes it play.
    """

    plan_id: str
    limb: Limb
    motion: Motion
    model: str
    method: str
    start: int
    asked: int = 0
    learned: Plan | None = None
    feedback: bool = False
    cancelled: threading.Event = field(default_factory=threading.Event)


class Cancelled(Exception):  # noqa: N818 - not an error
    """A newer command, `stop` or the driver made this plan useless."""


def identified(limb: Limb) -> str:
    """Return when and on what a limb was identified; empty if its file tells of no such thing."""
    told = limb.provenance
    return f"{told['date']}, {told.get('source', 'no source given')}" if "date" in told else ""


def new_plan_id() -> str:
    """Return a name for a plan that was given none."""
    return uuid.uuid4().hex[:8]


def start_of(stamp: int, now: int) -> int:
    """Check the instant at which a motion is to start.

    Args:
        stamp: [ns] ROS time; 0: as soon as possible.
        now: [ns] ROS time.

    Raises:
        ValueError: it lies too far back or ahead to be meant; says how far.
    """
    ahead = (stamp - now) / NANOSECONDS
    if stamp == 0 or -OLDEST_STAMP <= ahead <= FURTHEST_STAMP:
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
    motion = None
    if message.path:
        if message.motion or message.method == LEARNED:
            raise ValueError(
                "the command has a path, and a motion or a learned plan beside it: give one of them"
            )
        tip = points_of(message.path)
        motion = _along_path(None, tip, options, message.nearest_path or options.nearest_path)
    elif message.method != LEARNED:
        motion = Motion.named(
            message.motion,
            amplitude=message.amplitude or DEFAULT_AMPLITUDE,
            period=message.period or DEFAULT_PERIOD,
            cycles=message.cycles or DEFAULT_CYCLES,
            branch=options.branch,
        )
    return _request(message, motion, options, now)


def from_path(message: PathMessage, plan_id: str, options: PlannerOptions, now: int) -> Request:
    """Return what a path asks for.

    Raises:
        ValueError: the path is in another frame, too short, or cannot be timed.
    """
    frame = message.header.frame_id
    if frame not in ("", topics.BASE_FRAME):
        raise ValueError(f"the path is in frame '{frame}': send it in '{topics.BASE_FRAME}'")
    tip = points_of(each.pose.position for each in message.poses)
    stamps = [nanoseconds(pose.header.stamp) for pose in message.poses]
    time = (np.array(stamps) - stamps[0]) * 1e-9 if any(stamps) else None
    motion = _along_path(time, tip, options, options.nearest_path)
    return _request(MotionCommand(header=message.header, plan_id=plan_id), motion, options, now)


def _along_path(time: Array | None, tip: Array, options: PlannerOptions, nearest: bool) -> Motion:
    return Motion.from_tip_path(
        time, tip, branch=options.branch, limits=options.limits, nearest=nearest
    )


def _request(
    message: MotionCommand, motion: Motion | None, options: PlannerOptions, now: int
) -> Request:
    """Return the motion under the loads, by the method and from the instant that are asked for.

    What a command does not name is that of the parameters; without a motion it names a learned plan
    in place of it.
    """
    start = start_of(nanoseconds(message.header.stamp), now)
    carried = message if message.payload else options
    limb = options.limb.loaded(Load(carried.payload, carried.payload_at, message.mounting))
    model, learned = message.model or options.default_model, None
    if motion is None:
        learned = learned_plan(options.learned_plans, message.motion, limb)
        motion = Motion(learned.motion, learned.amplitude, learned.period, learned.cycles)
        limb, model, method = learned.limb, learned.model, LEARNED
    else:
        method = choose_method(model, message.method or options.default_method)
    if message.feedback and model != "der":
        raise ValueError(
            f"feedback corrects plans of the rod, not of the model {model}: ask for der"
        )
    feedback = message.feedback or (options.feedback and model == "der")
    return Request(message.plan_id, limb, motion, model, method, start, now, learned, feedback)


# The action --------------------------------------------------------------------------------------


@dataclass
class _Goal:
    """One goal, and how far the tracked tip was from the reference so far."""

    handle: ServerGoalHandle
    errors: list[float] = field(default_factory=list)

    @property
    def tip_error(self) -> float:
        """Mean distance [m]; NaN while no tip was tracked."""
        return float(np.mean(self.errors)) if self.errors else math.nan


class MotionAction:
    """Serves `planner/play_motion`. The planner plans and plays; this keeps who asked and tells.

    A goal stays ACCEPTED until it ends: rclpy's executor spins without rest while a callback waits,
    so no callback waits here.

    Args:
        node: the planner.
        check: returns what a command asks for; None: it cannot be planned, and why has been said.
        begin: plans and plays what is asked for.
        stop: ends the plan of an id.
        schedule: returns the schedule of a plan that is being played, or None.
    """

    def __init__(
        self,
        node: Node,
        check: Callable[[MotionCommand], Request | None],
        begin: Callable[[Request], None],
        stop: Callable[[str], None],
        schedule: Callable[[str], Schedule | None],
    ) -> None:
        self._check, self._begin, self._stop, self._schedule = check, begin, stop, schedule
        self._lock = threading.Lock()
        self._checked: Request | None = None
        self._goals: dict[str, _Goal] = {}
        self._server = ActionServer(
            node,
            PlayMotion,
            "~/play_motion",
            execute_callback=ServerGoalHandle.abort,  # never called: a goal ends as it ends
            goal_callback=self._on_request,
            handle_accepted_callback=self._on_goal,
            cancel_callback=self._on_cancel,
        )

    def _on_request(self, goal: PlayMotion.Goal) -> GoalResponse:
        self._checked = self._check(goal.command)
        return GoalResponse.REJECT if self._checked is None else GoalResponse.ACCEPT

    def _on_goal(self, handle: ServerGoalHandle) -> None:
        """Begin what was checked: rclpy calls both in a row."""
        request, self._checked = self._checked, None
        if request is not None:
            with self._lock:
                self._goals[request.plan_id] = _Goal(handle)
            self._begin(request)

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        with self._lock:
            found = [name for name, goal in self._goals.items() if goal.handle == handle]
        for plan_id in found:
            # The answer to the cancel request must be out before the goal ends.
            threading.Timer(0.05, self._stop, [plan_id]).start()
        return CancelResponse.ACCEPT if found else CancelResponse.REJECT

    def compare(self, state: LimbState) -> None:
        """Compare the tracked tip with the reference at the stamp of its image."""
        if not self._goals or not state.valid:
            return
        stamp = nanoseconds(state.header.stamp)
        with self._lock:
            goals = list(self._goals.items())
        for plan_id, goal in goals:
            if (schedule := self._schedule(plan_id)) is None:
                continue
            at, rows = (stamp - schedule.start) / GRID, np.arange(schedule.count)
            if 0 <= at <= rows[-1]:
                x, y = (np.interp(at, rows, tip) for tip in schedule.plan.tip_reference.T)
                goal.errors.append(math.hypot(state.tip.x - x, state.tip.y - y))

    def tell(self, plan_id: str, state: str, progress: float) -> None:
        """Publish feedback to who asked for a plan, if anybody did."""
        with self._lock:
            goal = self._goals.get(plan_id)
        if goal is not None:
            goal.handle.publish_feedback(
                PlayMotion.Feedback(state=state, progress=progress, tip_error=goal.tip_error)
            )

    def end(self, plan_id: str, outcome: str, reason: str) -> None:
        """Give who asked for a plan its result; may be called from any thread, and twice."""
        with self._lock:
            goal = self._goals.pop(plan_id, None)
        if goal is None:
            return
        result = PlayMotion.Result(
            outcome=outcome, reason=reason, plan_id=plan_id, tip_error=goal.tip_error
        )

        def conclude(handle: ServerGoalHandle) -> Any:
            if handle.is_cancel_requested:
                handle.canceled()
            elif outcome == "finished":
                handle.succeed()
            else:
                handle.abort()
            return result

        goal.handle.execute(conclude)
