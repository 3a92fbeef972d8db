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

from der_msgs.msg import PressureState
from der_planner.experiment.client import GraphClient
from der_planner.experiment.console import Progress
from der_planner.experiment.processes import (
    PAGE_TOKEN,
    STOP_ORDER,
    GraphError,
    GraphSetup,
    NodeError,
    NodeProcess,
    NodeSpec,
)
from limb_interfaces import qos, topics

DISCOVERY = 1.0
"""The orchestrator listens for another graph this long [s] before it starts nodes."""
ARMING = 5.0
"""The driver may refuse to be armed this long [s] before the run is given up."""
PORT_VENTS = 3.0
"""The process of a dead driver's port has vented the limb after this time [s]."""
VENTED_PRESSURE = 1000.0
"""A limb counts as vented below this differential pressure [Pa]."""


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
        plan_id: of the plan that was played; empty for pressures without a plan.
    """

    bag: Path
    cpu_percent: dict[str, float]
    real_time_factor: float
    plan_id: str = ""


class GraphPlayer(ABC):
    """Plays something on the graph; whatever happens, the limb is vented and every node stopped.

    Args:
        setup: the nodes.
        logs: folder of the nodes' logs.
        progress: shows what happens.
    """

    def __init__(self, setup: GraphSetup, logs: Path, progress: Progress) -> None:
        self._setup, self._logs, self._progress = setup, logs, progress
        self._processes: dict[str, NodeProcess] = {}

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
            specs = self._setup.nodes(port)
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
        remap = self._setup.hardware.remap if self._setup.hardware is not None else None
        for spec in specs:
            self._processes[spec.executable] = NodeProcess(
                spec.package, spec.executable, spec.parameters, self._logs, remap
            )
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
        return GraphRun(bag, cpu, float(factor), playing.plan_id)

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
            self._progress.bar(min(played(), length), length, "played")
            return played() >= length

        client.wait_for(finished, length + 30.0, "the end of the motion")

    def _vent(self, client: GraphClient) -> None:
        client.call("pressure_driver/vent")
        client.newest.pop(topics.PRESSURE_STATE, None)

        def vented() -> bool:
            state = client.newest.get(topics.PRESSURE_STATE)
            measured = state.measured_differential if state is not None else []
            return bool(measured) and all(abs(value) < VENTED_PRESSURE for value in measured)

        client.wait_for(vented, 30.0, "the chambers to vent")

    def _vent_after_error(self, client: GraphClient) -> None:
        """Vent; where the driver has died, the process of its port does it by itself."""
        driver = self._processes.get("pressure_driver")
        if driver is None:
            return
        self._progress.say("  venting the limb")
        client.watch(())
        try:
            if driver.alive:
                self._vent(client)
            else:
                client.spin(PORT_VENTS)
        except GraphError as error:
            self._progress.say(
                f"  WARNING: the limb may still be under pressure ({error}); close its air supply"
            )

    @contextlib.contextmanager
    def _everything_stops(self, client: GraphClient) -> Iterator[None]:
        """Stop every node at the end; after an error or an interrupt, vent first."""
        try:
            yield
        except BaseException:
            self._vent_after_error(client)
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
