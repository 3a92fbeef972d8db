"""One trial on the running graph: start the nodes, play the motion, vent, stop, keep the bag."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from der_msgs.msg import MotionCommand, PressurePlan, PressureState
from limb_interfaces import qos, stamps, topics
from orchestrator.client import GraphClient
from orchestrator.errors import GraphError, NodeError
from orchestrator.options import Options, Trial
from orchestrator.processes import NodeProcess
from orchestrator.progress import Progress

PLAN_TIMEOUT = 120.0
VENTED_PRESSURE = 1000.0
"""Differential pressure below which a limb counts as vented [Pa]."""
STOP_ORDER = (
    "planner",
    "apriltag_tracker",
    "synthetic_camera",
    "limb_twin",
    "recorder",
    "pressure_driver",
    "board_emulator",
)


@dataclass(frozen=True)
class NodeSpec:
    """What is needed to start one node."""

    package: str
    executable: str
    parameters: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class GraphRun:
    """What a trial left behind.

    Attributes:
        bag: folder of the bag.
        cpu_percent: CPU use of each process while the motion played, in per cent of one core.
        real_time_factor: simulated over real seconds of the twin; NaN on hardware.
        duration: of the played motion [s].
    """

    bag: Path
    cpu_percent: dict[str, float]
    real_time_factor: float
    duration: float


def node_specs(
    trial: Trial, options: Options, limb: Path | None, port: str, metadata: dict[str, Any]
) -> list[NodeSpec]:
    """Return the nodes of a trial in the order in which they start."""
    hardware = options.hardware
    driver = {"port": port, "protocol": "ezloop"}
    planner = {"limb_file": str(limb) if limb else ""}
    recorder = {
        "output": str(options.out / "bags" / trial.name),
        "metadata": json.dumps(metadata),
        "record_images": options.record_images,
    }
    if hardware is not None:
        return [
            NodeSpec("pressure_driver", "pressure_driver", {**driver, **hardware.driver}),
            NodeSpec("apriltag_tracker", "apriltag_tracker", dict(hardware.tracker)),
            NodeSpec("der_planner", "planner", {**planner, **hardware.planner}),
            NodeSpec("der_planner", "recorder", {**recorder, **hardware.recorder}),
        ]
    return [
        NodeSpec("pressure_driver", "board_emulator", {"port_link": port, "seed": trial.seed}),
        NodeSpec("pressure_driver", "pressure_driver", driver),
        NodeSpec("der_planner", "limb_twin", {"seed": trial.seed}),
        NodeSpec("apriltag_tracker", "synthetic_camera", {"seed": trial.seed}),
        NodeSpec("apriltag_tracker", "apriltag_tracker"),
        NodeSpec("der_planner", "planner", planner),
        NodeSpec("der_planner", "recorder", recorder),
    ]


class GraphTrial:
    """Runs one trial; use `play`.

    Args:
        trial, options: what to play.
        limb: limb file for the planner, or None for the default limb.
        metadata: stored in the bag.
        progress: shows what happens.
    """

    def __init__(
        self,
        trial: Trial,
        options: Options,
        limb: Path | None,
        metadata: dict[str, Any],
        progress: Progress,
    ) -> None:
        self._trial = trial
        self._options = options
        self._limb = limb
        self._metadata = metadata
        self._progress = progress
        self._logs = options.out / "logs" / trial.name
        self._processes: dict[str, NodeProcess] = {}
        self._driver_spec: NodeSpec | None = None

    def play(self) -> GraphRun:
        """Start the graph, play the motion and stop everything, whatever happens on the way.

        Raises:
            GraphError: a node is not ready, the planner refuses, the driver reports a fault.
            NodeError: a node cannot be started or has died.
        """
        with tempfile.TemporaryDirectory(prefix="der_limb_") as folder, GraphClient() as client:
            port = str(Path(folder) / "board")
            specs = node_specs(self._trial, self._options, self._limb, port, self._metadata)
            self._refuse_second_graph(client, specs)
            self._watch_topics(client)
            with self._everything_stops(client):
                self._start(client, specs, port)
                return self._play_motion(client)

    def _refuse_second_graph(self, client: GraphClient, specs: list[NodeSpec]) -> None:
        others = set(client.other_nodes()) & {spec.executable for spec in specs}
        if others:
            raise GraphError(
                f"another graph is running in this ROS domain (node '{min(others)}'): stop it, or "
                "set ROS_DOMAIN_ID to another number for one of them"
            )

    def _watch_topics(self, client: GraphClient) -> None:
        client.subscribe(PressurePlan, topics.PLAN, qos.LATCHED)
        client.subscribe(PressureState, topics.PRESSURE_STATE, qos.STATES)

    def _start(self, client: GraphClient, specs: list[NodeSpec], port: str) -> None:
        begin = time.monotonic()
        self._progress.say(f"  starting {', '.join(spec.executable for spec in specs)}")
        remap = self._options.hardware.remap if self._options.hardware else None
        for spec in specs:
            process = NodeProcess(spec.package, spec.executable, spec.parameters, self._logs, remap)
            self._processes[spec.executable] = process
            if spec.executable == "pressure_driver":
                self._driver_spec = spec
            client.watch(self._processes.values())
            if spec.executable == "board_emulator":
                client.wait_for(lambda: os.path.exists(port), 60.0, "the emulated board's port")
        client.wait_ready(self._processes)
        self._progress.say(f"  ready after {time.monotonic() - begin:.1f} s")

    def _play_motion(self, client: GraphClient) -> GraphRun:
        bag = Path(client.call("recorder/start"))
        client.call("pressure_driver/arm")
        publisher = client.node.create_publisher(MotionCommand, topics.COMMAND, qos.COMMANDS)
        client.wait_for(publisher.get_subscription_count, 10.0, "the planner to listen")
        publisher.publish(self._command())
        plan = client.wait_for(lambda: self._plan_or_refusal(client), PLAN_TIMEOUT, "the plan")
        self._progress.say(
            f"  planned in {plan.solve_time:.2f} s, "
            f"predicted error {plan.predicted_error * 100:.2f} cm"
        )
        before = {name: process.measure_cpu() for name, process in self._processes.items()}
        begin = time.monotonic()
        self._await_end(client, plan)
        wall = time.monotonic() - begin
        cpu = {
            name: 100.0 * (process.measure_cpu() - before[name]) / wall
            for name, process in self._processes.items()
        }
        factor = client.diagnostic_values("limb_twin").get("real_time_factor", "nan")
        self._vent(client)
        client.call("recorder/stop", timeout=20.0)
        return GraphRun(bag, cpu, float(factor), plan.time[-1] if plan.time else 0.0)

    def _command(self) -> MotionCommand:
        return MotionCommand(
            motion=self._trial.motion,
            model=self._trial.model,
            method=self._trial.method,
            amplitude=self._options.amplitude,
            period=self._options.period,
            cycles=self._options.cycles,
            plan_id=self._trial.name,
        )

    def _plan_or_refusal(self, client: GraphClient) -> PressurePlan | None:
        plan = client.newest.get(topics.PLAN)
        if plan is not None and plan.plan_id == self._trial.name:
            return plan
        said = client.diagnostic_values("planner")
        if said.get("state") == "refused":
            raise GraphError(f"the planner refused: {said.get('reason', 'no reason given')}")
        return None

    def _await_end(self, client: GraphClient, plan: PressurePlan) -> None:
        begin = stamps.seconds(plan.header.stamp)
        length = plan.time[-1]

        def played() -> float:
            return float(client.node.get_clock().now().nanoseconds * 1e-9 - begin)

        def finished() -> bool:
            state = client.newest.get(topics.PRESSURE_STATE)
            if state is not None and state.mode == PressureState.FAULT:
                raise GraphError(f"the driver vented: {'; '.join(state.faults) or 'fault'}")
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

        client.wait_for(vented, 15.0, "the chambers to vent")

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
