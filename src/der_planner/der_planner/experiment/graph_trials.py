"""What is played on the graph: a trial of a planned motion, or the pressures of a calibration."""

from __future__ import annotations

import math
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage

from der_msgs.msg import MotionCommand, PressurePlan, PressureSetpoint, PressureState
from der_planner.experiment.client import GraphClient
from der_planner.experiment.console import Progress
from der_planner.experiment.graph_run import GraphPlayer, GraphRun, Playing
from der_planner.experiment.options import TrialRun
from der_planner.experiment.processes import GraphError, GraphSetup, Hardware
from der_planner.identification import Excitation
from der_planner.limb import Limb
from der_planner.methods import LEARNED
from der_planner.planning import paths
from der_planner.planning.streaming import GRID, first_stamp
from limb_interfaces import qos, stamps, topics

PLAN_TIMEOUT = 120.0
"""A plan is waited for this long [s]."""
LEAD = 200_000_000
"""A setpoint of a calibration is sent at least this much [ns] before its stamp."""
PAUSE = 50_000_000
"""What is due is looked for again after this time [ns] at the latest."""


def play_on_graph(run: TrialRun, progress: Progress) -> dict[str, Any]:
    """Play a run on the graph; return what is kept of it beside its bag.

    Raises:
        GraphError: a node is not ready, the planner refuses, the driver reports a fault.
        NodeError: a node cannot be started or has died.
    """
    played = GraphTrial(run, progress).play()
    factor = played.real_time_factor
    return {
        "bag": str(played.bag.relative_to(run.options.out)),
        "plan_id": played.plan_id,
        "cpu_percent": {name: round(value, 1) for name, value in played.cpu_percent.items()},
        "twin_real_time_factor": None if math.isnan(factor) else round(factor, 3),
    }


def _bag_folder(out: Path, name: str) -> Path:
    """Return the folder of a run's bag; the bag of a run that was stopped goes to ``stopped/``."""
    bag, number = out / "bags" / name, 1
    while (kept := out / "stopped" / f"{name}_{number}").exists():
        number += 1
    if bag.exists():
        kept.parent.mkdir(exist_ok=True)
        bag.rename(kept)
    return bag


class GraphTrial(GraphPlayer):
    """Plays one run of a planned motion; use `play_on_graph`."""

    def __init__(self, run: TrialRun, progress: Progress) -> None:
        self._run, self._trial, self._options = run, run.trial, run.options
        setup = GraphSetup(
            _bag_folder(run.options.out, run.trial.name),
            run.metadata,
            seed=run.trial.seed,
            run=run.trial.run - 1,
            limb=run.limb,
            hardware=run.options.hardware,
            planner=self._planner_parameters(),
            record_images=run.options.record_images,
            page=run.options.page,
        )
        super().__init__(setup, run.options.out / "logs" / run.trial.name, progress)
        self._publisher: Any = None

    def _planner_parameters(self) -> dict[str, Any]:
        parameters: dict[str, Any] = {
            "limb_file": str(self._run.limb_file or ""),
            "mounting": self._options.loads.mounting,
            "payload": self._options.loads.payload,
            "payload_at": self._options.loads.payload_at or 0.0,
            "feedback": self._trial.feedback,
        }
        if self._run.learned is not None:
            parameters["learned_plans"] = str(self._run.learned.parent)
        elif self._options.path is not None:
            # A path names no model: it gets the planner's defaults.
            parameters["default_model"] = self._trial.model
            parameters["nearest_path"] = self._options.nearest
            if self._trial.model == "der":
                parameters["default_method"] = self._trial.method
        return parameters

    def _join(self, client: GraphClient) -> None:
        super()._join(client)
        client.subscribe(PressurePlan, topics.PLAN, qos.LATCHED)
        # Before the nodes start, so that the planner knows of it when it is ready.
        drawn = self._options.path is not None and self._run.learned is None
        kind, topic = (PathMessage, topics.PATH) if drawn else (MotionCommand, topics.COMMAND)
        self._publisher = client.node.create_publisher(kind, topic, qos.COMMANDS)

    def _begin(self, client: GraphClient) -> Playing:
        drawn = self._options.path if self._run.learned is None else None
        client.wait_for(lambda: self._planner_listens(client), 30.0, "the planner to listen")
        client.newest.pop(topics.PLAN, None)
        self._publisher.publish(self._path(drawn) if drawn else self._command())
        plan = client.wait_for(lambda: self._plan_or_refusal(client), PLAN_TIMEOUT, "the plan")
        self._progress.say(
            f"  planned in {plan.solve_time:.2f} s, "
            f"predicted error {plan.predicted_error * 100:.2f} cm"
        )
        return Playing(
            stamps.seconds(plan.header.stamp),
            float(plan.time[-1]),
            feed=self._warnings_of(client, plan.plan_id),
            plan_id=plan.plan_id,
        )

    def _warnings_of(self, client: GraphClient, plan_id: str) -> Callable[[], None]:
        """Return what shows the warnings of a plan once the planner's diagnostics have them."""
        shown: list[str] = []

        def show() -> None:
            said = client.diagnostic_values("planner")
            played = said.get("plan_id") == plan_id and said.get("state") == "streaming"
            if played and not shown:
                shown.append(said.get("reason", ""))
                if shown[0]:
                    self._progress.say(f"  warning: {shown[0]}")

        return show

    def _planner_listens(self, client: GraphClient) -> bool:
        # The recorder may listen, too.
        found = client.node.get_subscriptions_info_by_topic(self._publisher.topic_name)
        return any(info.node_name == "planner" for info in found)

    def _path(self, file: Path) -> PathMessage:
        """Return the path in a file; stamps are relative, all zero for a path without times."""
        time, tip = paths.read_csv(file)
        message = PathMessage()
        message.header.frame_id = topics.BASE_FRAME
        for index, (x, y) in enumerate(tip):
            pose = PoseStamped()
            pose.header.frame_id = topics.BASE_FRAME
            if time is not None:
                since = round((float(time[index]) - float(time[0])) * stamps.NANOSECONDS)
                pose.header.stamp = stamps.stamp_from_nanoseconds(since)
            pose.pose.position.x, pose.pose.position.y = float(x), float(y)
            message.poses.append(pose)
        return message

    def _command(self) -> MotionCommand:
        learned = self._run.learned
        return MotionCommand(
            # A learned plan's name stands in place of the motion's.
            motion=self._trial.motion if learned is None else learned.stem,
            model=self._trial.model,
            method=self._trial.method if learned is None else LEARNED,
            amplitude=self._options.amplitude,
            period=self._options.period,
            cycles=self._options.cycles,
            plan_id=self._trial.name,
        )

    def _plan_or_refusal(self, client: GraphClient) -> PressurePlan | None:
        plan = client.newest.get(topics.PLAN)
        named = self._options.path is None
        if plan is not None and (plan.plan_id == self._trial.name or not named):
            return plan
        said = client.diagnostic_values("planner")
        if said.get("state") == "refused":
            raise GraphError(f"the planner refused: {said.get('reason', 'no reason given')}")
        return None


class GraphCalibration(GraphPlayer):
    """Plays the pressures of a calibration; use `play`.

    Args:
        excitation: pressures to play, on the grid of 50 ms.
        folder: gets the bag (``bag``) and the nodes' logs (``logs``).
        metadata: stored in the bag.
        progress: shows what happens.
        limb: whose gravity and masses the twin gets; None: no loads.
        seed: of the twin.
        hardware: in place of the twin.
    """

    def __init__(
        self,
        excitation: Excitation,
        folder: Path,
        metadata: dict[str, Any],
        progress: Progress,
        *,
        limb: Limb | None = None,
        seed: int = 0,
        hardware: Hardware | None = None,
    ) -> None:
        setup = GraphSetup(folder / "bag", metadata, seed=seed, limb=limb, hardware=hardware)
        super().__init__(setup, folder / "logs", progress)
        self._excitation = excitation
        # The driver refuses a plan that it has heard before an arming: each run has its own.
        self._plan_id = f"calibration-{uuid.uuid4().hex[:8]}"
        self._start_stamp = 0
        self._next = 0
        self._publisher: Any = None
        self._last_state: PressureState | None = None

    def play(self) -> GraphRun:
        """Play the calibration; see `GraphPlayer.play`. Says when setpoints were not executed."""
        run = super().play()
        state = self._last_state
        lost = state.setpoints_late + state.setpoints_refused if state is not None else 0
        if lost:
            self._progress.say(
                f"  WARNING: the driver did not take {lost} of {len(self._excitation.time)} "
                f"setpoints; its log in {self._logs} says why"
            )
        return run

    def _join(self, client: GraphClient) -> None:
        client.subscribe(PressureState, topics.PRESSURE_STATE, qos.STATES, self._keep_state)
        # Before the nodes start, so that the recorder knows the topic when it begins to record.
        self._publisher = client.node.create_publisher(
            PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINTS
        )

    def _keep_state(self, state: PressureState) -> None:
        self._last_state = state

    def _begin(self, client: GraphClient) -> Playing:
        client.wait_for(self._publisher.get_subscription_count, 30.0, "the driver to listen")
        self._start_stamp = first_stamp(_now(client) + 2 * PAUSE, LEAD)
        self._next = 0
        return Playing(
            self._start_stamp / stamps.NANOSECONDS,
            float(self._excitation.time[-1]),
            lambda: self._send_due(_now(client)),
        )

    def _send_due(self, now: int) -> None:
        """Publish every setpoint that must be under way before the next look."""
        while self._next < len(self._excitation.time):
            stamp = self._start_stamp + self._next * GRID
            if stamp - now > LEAD + PAUSE:
                return
            setpoint = PressureSetpoint(plan_id=self._plan_id, index=self._next)
            setpoint.header.stamp = stamps.stamp_from_nanoseconds(stamp)
            setpoint.header.frame_id = topics.BASE_FRAME
            values = self._excitation.differential_pressure[self._next]
            setpoint.differential_pressure = values.tolist()
            self._publisher.publish(setpoint)
            self._next += 1


def _now(client: GraphClient) -> int:
    return int(client.node.get_clock().now().nanoseconds)
