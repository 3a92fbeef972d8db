"""One run of the whole graph with feedback, in which one thing after the other happens."""

from __future__ import annotations

import os
import stat
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters

from der_msgs.msg import (
    LimbEstimate,
    LimbPush,
    LimbState,
    MotionCommand,
    PressurePlan,
    PressureSetpoint,
    PressureState,
)
from limb_interfaces import qos, stamps, topics

Array = np.ndarray

SLOW_PLANNER = """#!{python}
# The planner, whose replans take as long as a file says: "COUNT SECONDS".
import time
from pathlib import Path
from der_planner.control.feedback import Feedback
from der_planner.nodes.entry import planner

told = Path({told!r})
command = Feedback.command

def slow(feedback, instant):
    count, seconds = told.read_text().split()
    if int(count) > 0:
        told.write_text(f"{{int(count) - 1}} {{seconds}}")
        end = time.perf_counter() + float(seconds)
        while time.perf_counter() < end:
            pass
    return command(feedback, instant)

Feedback.command = slow
raise SystemExit(planner())
"""


@dataclass
class Heard:
    """What was heard, in the order in which it came; stamps in ns."""

    setpoints: list[PressureSetpoint] = field(default_factory=list)
    estimates: list[LimbEstimate] = field(default_factory=list)
    states: list[PressureState] = field(default_factory=list)
    seen: list[LimbState] = field(default_factory=list)
    truth: list[LimbState] = field(default_factory=list)
    plans: list[PressurePlan] = field(default_factory=list)


class FeedbackGraph:
    """Twin, board, camera, tracker, driver and planner, and the means to disturb them.

    Args:
        graph: of the test.
        seed: of the twin.
        gravity: (3,) that the twin feels [m/s²].
        planner: parameters of the planner.
    """

    def __init__(self, graph, seed: int, gravity, **planner) -> None:
        self.graph, self.client, self.heard = graph, graph.client, Heard()
        self._slow = graph.folder / "slow"
        self.slow_down(0, 0.0)
        link = graph.folder / "board"
        node, heard = self.client.node, self.heard
        for kind, topic, profile, kept in (
            (PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINTS, heard.setpoints),
            (LimbEstimate, topics.ESTIMATE, qos.STATES, heard.estimates),
            (PressureState, topics.PRESSURE_STATE, qos.STATES, heard.states),
            (LimbState, topics.LIMB_STATE, qos.STATES, heard.seen),
            (LimbState, topics.TWIN_GROUND_TRUTH, qos.STATES, heard.truth),
            (PressurePlan, topics.PLAN, qos.LATCHED, heard.plans),
        ):
            self.client.subscribe(kind, topic, profile, kept.append)
        self._commands = node.create_publisher(MotionCommand, topics.COMMAND, qos.COMMANDS)
        self._pushes = node.create_publisher(LimbPush, topics.TWIN_PUSH, qos.COMMANDS)
        graph.start("pressure_driver", "board_emulator", port_link=str(link), seed=seed)
        self.planner = graph.start("slowed", "planner", **planner)
        graph.start("der_planner", "limb_twin", seed=seed, gravity=list(gravity))
        self.camera = graph.start("apriltag_tracker", "synthetic_camera", seed=seed)
        graph.start("apriltag_tracker", "apriltag_tracker")
        self.wait(link.exists, "the board's port")
        graph.start("pressure_driver", "pressure_driver", port=str(link))
        self.client.watch(graph.processes)
        self.client.wait_ready([process.executable for process in graph.processes])
        self.wait(self._commands.get_subscription_count, "the planner to listen")
        self.wait(self._pushes.get_subscription_count, "the twin to listen")
        self.wait(lambda: len(heard.seen) > 30, "the camera")

    @staticmethod
    def install_slow_planner(folder: Path) -> str:
        """Write a planner that can be slowed down; return the prefix of its package."""
        place = folder / "lib" / "slowed" / "planner"
        place.parent.mkdir(parents=True)
        place.write_text(SLOW_PLANNER.format(python=sys.executable, told=str(folder / "slow")))
        place.chmod(place.stat().st_mode | stat.S_IXUSR)
        return os.pathsep.join([str(folder), os.environ["AMENT_PREFIX_PATH"]])

    # What is done to it --------------------------------------------------------------------

    def slow_down(self, count: int, seconds: float) -> None:
        """Let the next ``count`` replans take ``seconds`` more."""
        part = self._slow.with_suffix(".part")
        part.write_text(f"{count} {seconds}")
        part.replace(self._slow)

    def arm(self) -> None:
        """Arm the driver, and wait until the planner has heard of it."""
        self.client.call("pressure_driver/arm", 30.0)
        said = self.client.diagnostic_values
        self.wait(lambda: said("planner").get("driver") == "ARMED", "the planner to hear of it")

    def command(self, plan_id: str, **motion) -> PressurePlan:
        """Command a motion, and return its plan."""
        self._commands.publish(MotionCommand(plan_id=plan_id, feedback=True, **motion))
        return self.wait(
            lambda: next((p for p in self.heard.plans if p.plan_id == plan_id), None), "the plan"
        )

    def push(self, at: int, **push) -> None:
        """Push the limb's tip, or hang a mass on it, at an instant [ns]."""
        message = LimbPush(arc_length=0.244, duration=push.get("duration", 0.0))
        message.force.y, message.mass = push.get("force", 0.0), push.get("mass", 0.0)
        message.header.stamp = stamps.stamp_from_nanoseconds(at)
        self._pushes.publish(message)

    def set_parameter(self, node: str, name: str, value: float | str) -> None:
        """Set a parameter of a node that runs."""
        client = self.client.node.create_client(SetParameters, f"{node}/set_parameters")
        self.wait(client.service_is_ready, f"the parameters of {node}")
        kind = ParameterType.PARAMETER_STRING
        given = ParameterValue(type=kind, string_value=value) if isinstance(value, str) else None
        given = given or ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
        request = SetParameters.Request(parameters=[Parameter(name=name, value=given)])
        answer = client.call_async(request)
        self.wait(answer.done, f"{node} to take {name}")
        assert answer.result().results[0].successful, answer.result().results[0].reason

    # Waiting -------------------------------------------------------------------------------

    def wait(self, condition, what: str, timeout: float = 90.0):
        """Serve callbacks until a condition holds; return its value."""
        return self.client.wait_for(condition, timeout, what)

    def now(self) -> int:
        """Return the present [ns]."""
        return int(self.client.node.get_clock().now().nanoseconds)

    def states_are_tracking(self) -> bool:
        """Tell whether the driver plays setpoints, without a fault."""
        newest = self.heard.states[-1]
        return newest.mode == PressureState.TRACKING and not newest.faults

    def board_was_lost(self) -> bool:
        """Tell whether the driver vents as it did not hear its board in time: a busy machine."""
        return any("no telemetry" in fault for fault in self.heard.states[-1].faults)

    def until(self, instant: int) -> None:
        """Wait for an instant [ns]."""
        self.wait(lambda: self.now() >= instant, "an instant", 60.0)


@dataclass(frozen=True)
class Series:
    """A run of one plan, in the plan's seconds.

    Attributes:
        time: (K,) of the true shapes [s].
        tip, reference: (K, 2) [m].
        estimate_time: (L,) [s].
        estimates: (L,) messages.
        setpoints: (plan's setpoints, M) as they were revised last [Pa].
        revisions: (plan's setpoints,) highest revision of each; −1: it never came.
    """

    time: Array
    tip: Array
    reference: Array
    estimate_time: Array
    estimates: list[LimbEstimate]
    setpoints: Array
    revisions: Array

    @classmethod
    def of(cls, heard: Heard, plan: PressurePlan) -> Series:
        """Return what was heard of a plan."""
        start = stamps.nanoseconds(plan.header.stamp)

        def seconds(message) -> float:
            return (stamps.nanoseconds(message.header.stamp) - start) * 1e-9

        inside = [m for m in heard.truth if 0.0 <= seconds(m) <= plan.time[-1]]
        time = np.array([seconds(m) for m in inside])
        wanted = np.array(plan.tip_reference).reshape(-1, 2)
        estimates = [m for m in heard.estimates if m.plan_id == plan.plan_id]
        sent = np.full((len(plan.time), plan.segment_count), np.nan)
        revisions = np.full(len(plan.time), -1)
        for message in heard.setpoints:
            if message.plan_id == plan.plan_id and message.revision > revisions[message.index]:
                sent[message.index] = message.differential_pressure
                revisions[message.index] = message.revision
        return cls(
            time,
            np.array([(m.tip.x, m.tip.y) for m in inside]),
            np.column_stack([np.interp(time, plan.time, axis) for axis in wanted.T]),
            np.array([seconds(m) for m in estimates]),
            estimates,
            sent,
            revisions,
        )

    def error(self, begin: float, end: float) -> Array:
        """Return the distances [m] of the true tip from r̄ between two instants [s]."""
        inside = (self.time >= begin) & (self.time < end)
        return np.linalg.norm((self.tip - self.reference)[inside], axis=1)

    def told(self, begin: float, end: float) -> list[LimbEstimate]:
        """Return the estimates between two instants [s]."""
        both = zip(self.estimate_time, self.estimates, strict=True)
        return [message for time, message in both if begin <= time < end]

    def correction(self, begin: float, end: float) -> Array:
        """Return the largest correction of each estimate between two instants [Pa]."""
        return np.array([np.abs(m.correction).max() for m in self.told(begin, end)])
