"""One run of the graph: start the nodes, play something, vent, stop, keep the bag."""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage

from der_msgs.msg import MotionCommand, PressurePlan, PressureState
from der_planner.experiment.client import GraphClient
from der_planner.experiment.errors import GraphError, NodeError
from der_planner.experiment.node_specs import (
    PAGE_TOKEN,
    STOP_ORDER,
    Hardware,
    NodeSpec,
    node_specs,
)
from der_planner.experiment.options import Options, Trial
from der_planner.experiment.processes import NodeProcess
from der_planner.experiment.progress import Progress
from der_planner.limb import Limb
from der_planner.methods import LEARNED
from der_planner.planning import paths
from limb_interfaces import qos, stamps, topics

PLAN_TIMEOUT = 120.0
DISCOVERY = 1.0
"""How long the orchestrator listens for another graph before it starts nodes [s]."""
ARMING = 5.0
"""For how long the driver may refuse to be armed before the run is given up [s]."""
VENTED_PRESSURE = 1000.0
"""Differential pressure below which a limb counts as vented [Pa]."""


@dataclass(frozen=True)
class Playing:
    """What the graph plays, from when to when.

    Attributes:
        begin: ROS time at which the first setpoint takes effect [s].
        length: from the first setpoint to the last [s].
        feed: called at least every 50 ms until the end; publishes what is due, if the orchestrator
            is the one who publishes, or shows what is told of the plan meanwhile.
        plan_id: of the plan, if there is one.
    """

    begin: float
    length: float
    feed: Callable[[], None] = lambda: None
    plan_id: str = ""


@dataclass(frozen=True)
class GraphRun:
    """What a run left behind.

    Attributes:
        bag: folder of the bag.
        cpu_percent: CPU use of each process while the motion played, in per cent of one core.
        real_time_factor: simulated over real seconds of the twin; NaN on hardware.
        duration: of the played motion [s].
        plan_id: of the plan that was played; empty for pressures without a plan.
    """

    bag: Path
    cpu_percent: dict[str, float]
    real_time_factor: float
    duration: float
    plan_id: str = ""


class GraphPlayer(ABC):
    """Plays something on the graph; whatever happens, the limb is vented and every node stopped.

    Args:
        logs: folder of the nodes' logs.
        hardware: in place of the twin, or None.
        progress: shows what happens.
    """

    def __init__(self, logs: Path, hardware: Hardware | None, progress: Progress) -> None:
        self._logs = logs
        self._hardware = hardware
        self._remap = hardware.remap if hardware is not None else None
        self._progress = progress
        self._processes: dict[str, NodeProcess] = {}
        self._driver_spec: NodeSpec | None = None

    @abstractmethod
    def _specs(self, port: str) -> list[NodeSpec]:
        """Return the nodes in the order in which they start."""

    @abstractmethod
    def _begin(self, client: GraphClient) -> Playing:
        """Arrange what is played; the recorder runs and the driver is armed."""

    def play(self) -> GraphRun:
        """Start the graph, play and stop everything, whatever happens on the way.

        Raises:
            GraphError: a node is not ready, the planner refuses, the driver reports a fault.
            NodeError: a node cannot be started or has died.
        """
        with tempfile.TemporaryDirectory(prefix="der_limb_") as folder, GraphClient() as client:
            port = str(Path(folder) / "board")
            specs = self._specs(port)
            client.spin(DISCOVERY)
            self._refuse_second_graph(client, specs)
            self._join(client)
            with self._everything_stops(client):
                self._start(client, specs, port)
                # A graph that was not seen at once, or that began meanwhile, is known by now.
                self._refuse_second_graph(client, specs, own=1)
                return self._record(client)

    def _join(self, client: GraphClient) -> None:
        """Subscribe and advertise, before the nodes start."""
        client.subscribe(PressureState, topics.PRESSURE_STATE, qos.STATES)

    def _refuse_second_graph(
        self, client: GraphClient, specs: list[NodeSpec], own: int = 0
    ) -> None:
        """Raise `GraphError` if nodes of another graph are seen beside ``own`` of each name."""
        count = client.count_nodes()
        others = [spec.executable for spec in specs if count[spec.executable] > own]
        if others:
            raise GraphError(
                f"another graph is running in this ROS domain (node '{min(others)}'): stop it, or "
                "set ROS_DOMAIN_ID to another number for one of them"
            )

    def _start(self, client: GraphClient, specs: list[NodeSpec], port: str) -> None:
        begin = time.monotonic()
        self._progress.say(f"  starting {', '.join(spec.executable for spec in specs)}")
        for spec in specs:
            process = NodeProcess(
                spec.package, spec.executable, spec.parameters, self._logs, self._remap
            )
            self._processes[spec.executable] = process
            if spec.executable == "pressure_driver":
                self._driver_spec = spec
            client.watch(self._processes.values())
            if spec.executable == "board_emulator":
                client.wait_for(lambda: os.path.exists(port), 60.0, "the emulated board's port")
        client.wait_ready(self._processes)
        self._progress.say(f"  ready after {time.monotonic() - begin:.1f} s")
        if "page" in self._processes:
            address = client.diagnostic_values("page").get("url", "unknown")
            self._progress.say(f"  the operator's page is at {address}?token={PAGE_TOKEN}")

    def _record(self, client: GraphClient) -> GraphRun:
        bag = Path(client.call("recorder/start"))
        self._arm(client)
        playing = self._begin(client)
        before = {name: process.measure_cpu() for name, process in self._processes.items()}
        begin = time.monotonic()
        self._await_end(client, playing)
        wall = time.monotonic() - begin
        cpu = {
            name: 100.0 * (process.measure_cpu() - before[name]) / wall
            for name, process in self._processes.items()
        }
        factor = client.diagnostic_values("limb_twin").get("real_time_factor", "nan")
        self._vent(client)
        client.call("recorder/stop", timeout=60.0)
        return GraphRun(bag, cpu, float(factor), playing.length, playing.plan_id)

    def _arm(self, client: GraphClient) -> None:
        """Arm the driver; what forbids it for a moment, as a late report of the board, may pass."""
        end = time.monotonic() + ARMING
        while True:
            try:
                client.call("pressure_driver/arm")
                return
            except GraphError:
                if time.monotonic() > end:
                    raise
            client.spin(0.2)

    def _await_end(self, client: GraphClient, playing: Playing) -> None:
        length = playing.length

        def played() -> float:
            return float(client.node.get_clock().now().nanoseconds * 1e-9 - playing.begin)

        def finished() -> bool:
            state = client.newest.get(topics.PRESSURE_STATE)
            if state is not None and state.mode == PressureState.FAULT:
                raise GraphError(f"the driver vented: {'; '.join(state.faults) or 'fault'}")
            playing.feed()
            return played() >= length

        client.wait_for(
            finished,
            length + 30.0,
            "the end of the motion",
            lambda _: self._progress.bar(played(), length, "played"),
        )
        self._progress.bar(length, length, "played")

    def _vent(self, client: GraphClient) -> None:
        client.call("pressure_driver/vent")
        client.newest.pop(topics.PRESSURE_STATE, None)

        def vented() -> bool:
            state = client.newest.get(topics.PRESSURE_STATE)
            measured = state.measured_differential if state is not None else []
            return bool(measured) and all(abs(value) < VENTED_PRESSURE for value in measured)

        client.wait_for(vented, 30.0, "the chambers to vent")

    def _vent_whatever_happened(self, client: GraphClient) -> None:
        """Vent after an error; a dead driver is started again, since boards have no watchdog."""
        driver = self._processes.get("pressure_driver")
        if driver is None or self._driver_spec is None:
            return
        self._progress.say("  venting the limb")
        client.watch(())
        try:
            if not driver.alive:
                spec = self._driver_spec
                client.diagnostics.pop(spec.executable, None)
                driver = NodeProcess(
                    spec.package,
                    spec.executable,
                    spec.parameters,
                    self._logs,
                    self._remap,
                    name="pressure_driver_restarted",
                )
                self._processes["pressure_driver"] = driver
                client.watch([driver])
                client.wait_ready([spec.executable])
            self._vent(client)
        except (GraphError, NodeError) as error:
            self._progress.say(
                f"  WARNING: the limb may still be under pressure ({error}); close its air supply"
            )
        client.watch(())

    @contextlib.contextmanager
    def _everything_stops(self, client: GraphClient) -> Iterator[None]:
        """Stop every node at the end; after an error or an interrupt, vent first."""
        try:
            yield
        except BaseException:
            self._vent_whatever_happened(client)
            self._stop_all()
            raise
        client.watch(())
        codes = self._stop_all()
        failed = {name: code for name, code in codes.items() if code != 0}
        if failed:
            name, code = next(iter(failed.items()))
            process = self._processes[name]
            raise NodeError(
                f"node '{name}' ended with exit code {code}. Its last words:\n"
                f"{process.last_words()}\nThe whole log: {process.log}"
            )

    def _stop_all(self) -> dict[str, int]:
        order = [name for name in STOP_ORDER if name in self._processes]
        return {name: self._processes[name].stop() for name in order}


class GraphTrial(GraphPlayer):
    """Runs one trial of a planned motion; use `play`.

    Args:
        trial, options: what to play.
        limb: limb file for the planner, or None for the default limb.
        robot: the same limb under the loads of the experiment, which the twin gets.
        metadata: stored in the bag.
        progress: shows what happens.
        learned: file of a learned plan, which is played in place of a new one.
    """

    def __init__(
        self,
        trial: Trial,
        options: Options,
        limb: Path | None,
        robot: Limb,
        metadata: dict[str, Any],
        progress: Progress,
        learned: Path | None = None,
    ) -> None:
        super().__init__(options.out / "logs" / trial.name, options.hardware, progress)
        self._trial = trial
        self._options = options
        self._limb = limb
        self._robot = robot
        self._metadata = metadata
        self._learned = learned

    def _specs(self, port: str) -> list[NodeSpec]:
        return node_specs(
            port,
            self._options.out / "bags" / self._trial.name,
            self._metadata,
            seed=self._trial.seed,
            run=self._trial.run - 1,
            limb=self._robot,
            hardware=self._hardware,
            planner=self._planner_parameters(),
            record_images=self._options.record_images,
            page=self._options.page,
        )

    def _planner_parameters(self) -> dict[str, Any]:
        parameters: dict[str, Any] = {
            "limb_file": str(self._limb) if self._limb else "",
            "mounting": self._options.mounting,
            "payload": self._options.payload,
            "payload_at": self._options.payload_at or 0.0,
            "feedback": self._trial.feedback,
        }
        if self._learned is not None:
            parameters["learned_plans"] = str(self._learned.parent)
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

    def _begin(self, client: GraphClient) -> Playing:
        drawn = self._options.path if self._learned is None else None
        kind, topic = (PathMessage, topics.PATH) if drawn else (MotionCommand, topics.COMMAND)
        publisher = client.node.create_publisher(kind, topic, qos.COMMANDS)
        # The recorder may listen, too.
        client.wait_for(lambda: self._planner_listens(client, topic), 30.0, "the planner to listen")
        client.newest.pop(topics.PLAN, None)
        publisher.publish(self._path(drawn) if drawn else self._command())
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

    def _planner_listens(self, client: GraphClient, topic: str) -> bool:
        found = client.node.get_subscriptions_info_by_topic(client.node.resolve_topic_name(topic))
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
        return MotionCommand(
            # A learned plan's name stands in place of the motion's.
            motion=self._trial.motion if self._learned is None else self._learned.stem,
            model=self._trial.model,
            method=self._trial.method if self._learned is None else LEARNED,
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
