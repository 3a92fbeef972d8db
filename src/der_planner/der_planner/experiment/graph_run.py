"""The graph of a run: nodes started, recording and armed, and left vented and stopped.

Beside the graphs of all runs, an experiment may have a page.
"""

from __future__ import annotations

import contextlib
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.executors import ExternalShutdownException

from der_msgs.msg import PressureState
from der_planner.experiment.client import GraphClient
from der_planner.experiment.console import Progress
from der_planner.experiment.options import Options
from der_planner.experiment.processes import (
    PAGE_TOKEN,
    GraphError,
    GraphSetup,
    NodeError,
    NodeProcess,
    NodeSpec,
    board_line,
)
from limb_interfaces import qos, topics
from limb_interfaces.clocks import CLOCK_OFF, LARGEST, Offset
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health, is_vented, message_version
from pressure_driver.protocols import USUAL_LIMIT

DISCOVERY = 1.0
"""The orchestrator listens for another graph this long [s] before it starts nodes."""
ARMING = 5.0
"""The driver may refuse to be armed this long [s] before the run is given up."""
COMPARING = 20.0
"""Clocks of other computers are compared with the driver's for this long [s] at the most."""
ELSEWHERE = 30.0
"""Nodes that somebody else starts are waited for this long [s]."""
STARTED = 2.0
"""The recorder has told this long [s] after the first setpoint that it records."""
PORT_VENTS = 3.0
"""The process of a dead driver's port has vented the limb after this time [s]."""
EXPERIMENT = "experiment"
"""Name of the node that says what the experiment does."""


@contextlib.contextmanager
def running_graph(
    client: GraphClient, setup: GraphSetup, logs: Path, progress: Progress
) -> Iterator[RunningGraph]:
    """Start the nodes of a run, record and arm; whatever happens then, vent and stop every node.

    Args:
        client: has subscribed and advertised already what the run needs: the recorder knows all
            topics when it begins to record.
        setup: the nodes.
        logs: folder of the nodes' logs.
        progress: shows what happens.

    Raises:
        GraphError: a node is not ready, or the driver cannot be armed.
        NodeError: a node cannot be started, has died, or did not end in order.
    """
    graph = RunningGraph(client, progress)
    client.subscribe(PressureState, topics.PRESSURE_STATE, qos.STATES)
    with tempfile.TemporaryDirectory(prefix="der_limb_") as folder:
        specs = setup.nodes(board_line(setup.protocol, folder))
        client.spin(DISCOVERY)
        _refuse_second_graph(client, specs)
        try:
            graph.start(specs, logs, setup.rig.remap)
            graph.bag = Path(client.call("recorder/start"))
            graph.check_clocks(bool((setup.planner or {}).get("feedback")))
            graph.arm()
            yield graph
        except BaseException:
            graph.vent_after_error()
            graph.stop()
            raise
        client.watch(())
        graph.stop()
    for process in graph.processes.values():
        if process.exit_code != 0:
            raise process.failure("did not end in order")


def _refuse_second_graph(client: GraphClient, specs: list[NodeSpec]) -> None:
    """Raise `GraphError` if nodes of another graph are seen.

    One that begins later, or is seen late, is found by the nodes, each of which looks for another
    one of its name.
    """
    count = client.count_nodes()
    # Of a node that somebody else starts there is one from the beginning.
    others = [spec.executable for spec in specs if count[spec.executable] > bool(spec.host)]
    if others:
        raise GraphError(
            f"another graph is running in this ROS domain (node '{min(others)}'): stop it, or "
            "set ROS_DOMAIN_ID to another number for one of them"
        )


@dataclass
class RunningGraph:
    """The nodes of a run, and what the run left behind; made by `running_graph`.

    Attributes:
        client: of the graph.
        progress: shows what happens.
        processes: of the nodes, by executable.
        elsewhere: the computers of nodes that somebody else has started, by executable.
        bag: folder of the bag.
        real_time_factor: simulated over real seconds of the twin; NaN on hardware.
    """

    client: GraphClient
    progress: Progress
    processes: dict[str, NodeProcess] = field(default_factory=dict)
    elsewhere: dict[str, str] = field(default_factory=dict)
    bag: Path = Path()
    real_time_factor: float = float("nan")

    def start(self, specs: list[NodeSpec], logs: Path, remap: dict[str, str]) -> None:
        """Start every node and wait until all are ready."""
        begin = time.monotonic()
        self.elsewhere = {spec.executable: spec.host for spec in specs if spec.host}
        specs = [spec for spec in specs if not spec.host]
        self.progress.say(f"  starting {', '.join(spec.executable for spec in specs)}")
        for spec in specs:
            self.processes[spec.executable] = NodeProcess(
                spec.package, spec.executable, spec.parameters, logs, remap
            )
            self.client.watch(self.processes.values())
            if spec.executable == "board_emulator":  # a driver ends where there is no board
                self.client.wait_ready([spec.executable])
        self._wait_elsewhere()
        self.client.wait_ready(self.processes)
        for name in ("apriltag_tracker", "pose_tracker"):
            status = self.client.diagnostics.get(name)
            if status is None or status.level != DiagnosticStatus.WARN:
                continue
            if CLOCK_OFF not in status.message:  # `check_clocks` says it, once it is known well
                self.progress.say(f"  warning: {name}: {status.message}")
        self.progress.say(f"  ready after {time.monotonic() - begin:.1f} s")

    def _wait_elsewhere(self) -> None:
        """Wait for the nodes that somebody else starts, and see that they speak as these do.

        Raises:
            GraphError: names those that are missing, not ready, or of another version.
        """
        if not self.elsewhere:
            return
        told = ", ".join(f"{name} on {host}" for name, host in self.elsewhere.items())
        self.progress.say(f"  waiting for {told}")
        try:
            self.client.wait_ready(self.elsewhere, ELSEWHERE, ELSEWHERE)
        except GraphError as error:
            raise GraphError(
                f"{error} ({told}). Is it started, with the same ROS_DOMAIN_ID, with "
                "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET on both computers, and is there no firewall "
                "between them (docs/guide/two_computers.md)?"
            ) from error
        for name, host in self.elsewhere.items():
            theirs = self.client.diagnostic_values(name).get("messages", "unknown")
            if theirs != message_version():
                raise GraphError(
                    f"node '{name}' on {host} has other messages ({theirs}) than this computer "
                    f"({message_version()}): bring both to the same version of the project"
                )

    def check_clocks(self, feedback: bool) -> None:
        """Say whose clock is off the driver's.

        Args:
            feedback: commands are to be corrected by what is measured: that wants stamps which are
                true.

        Raises:
            GraphError: a clock is too far off for feedback, or not known where there are several.
        """
        names = [name for name in (*self.processes, *self.elsewhere) if name != "pressure_driver"]
        if self.elsewhere:
            self.client.wait_for(
                lambda: all(self._offset(name).uncertainty < LARGEST for name in names),
                COMPARING,
                "the clocks of all nodes",
            )
        for name in names:
            offset = self._offset(name)
            if offset.warning:
                self.progress.say(f"  warning: {name}: {offset.warning}")
            if feedback and offset.too_far:
                raise GraphError(
                    f"not armed: feedback needs clocks that agree within {1e3 * LARGEST:.0f} ms, "
                    f"and {name} says: {offset.warning}. Without --feedback it is played"
                )

    def _offset(self, name: str) -> Offset:
        """Return what a node has said of its clock."""
        told = self.client.diagnostic_values(name)
        keys = ("clock_offset_s", "nan"), ("clock_uncertainty_s", "inf")
        return Offset(*(float(told.get(key, unknown)) for key, unknown in keys))

    def arm(self, patience: float = ARMING) -> None:
        """Arm the driver; what forbids it for a moment, as a late report of the board, may pass.

        Args:
            patience: with a driver that refuses [s].

        Raises:
            GraphError: it still refuses then.
        """
        end = time.monotonic() + patience
        while True:
            try:
                self.client.call("pressure_driver/arm")
                return
            except GraphError:
                if time.monotonic() > end:
                    raise
            self.client.spin(0.2)

    def play(self, begin: float, length: float, feed: Callable[[], None]) -> None:
        """Wait until a motion was played, then vent the limb and close the bag.

        Args:
            begin: ROS time at which the first setpoint takes effect [s].
            length: from the first setpoint to the last [s].
            feed: called at least every 50 ms until the end; publishes what is due, or shows what is
                told of the plan meanwhile.

        Raises:
            GraphError: the driver reports a fault, the recorder has stopped, or the chambers do not
                vent.
            NodeError: a node has died.
        """

        def finished() -> bool:
            state = self.client.newest.get(topics.PRESSURE_STATE)
            if state is not None and state.mode == PressureState.FAULT:
                raise GraphError(
                    f"the driver is in FAULT: {'; '.join(state.faults) or 'no reason'}"
                )
            feed()
            played = self.client.node.get_clock().now().nanoseconds * 1e-9 - begin
            recorder = self.client.diagnostic_values("recorder").get("state", "recording")
            if played > STARTED and recorder != "recording":
                said = self.client.diagnostics["recorder"].message
                raise GraphError(f"the recorder has stopped: {said}")
            self.progress.bar(min(played, length), length, "played")
            return bool(played >= length)

        self.client.wait_for(finished, length + 30.0, "the end of the motion")
        told = self.client.diagnostic_values("limb_twin")
        self.real_time_factor = float(told.get("real_time_factor", "nan"))
        self._vent()
        self.client.call("recorder/stop", timeout=60.0)

    def _vent(self) -> None:
        self.client.call("pressure_driver/vent", timeout=5.0)
        self.client.newest.pop(topics.PRESSURE_STATE, None)

        def vented() -> bool:
            state = self.client.newest.get(topics.PRESSURE_STATE)
            told = self.client.diagnostic_values("pressure_driver")
            limit = float(told.get("pressure_limit_pa", USUAL_LIMIT))
            return state is not None and is_vented(state, limit)

        self.client.wait_for(vented, 30.0, "the chambers to vent")

    def vent_after_error(self) -> None:
        """Vent; where the driver has died, the process of its port should, which nobody sees."""
        driver = self.processes.get("pressure_driver")
        if driver is None and "pressure_driver" not in self.elsewhere:
            return
        self.progress.say("  venting the limb")
        self.client.watch(() if driver is None else (driver,))
        try:
            self._vent()
        except (GraphError, NodeError) as error:
            self.progress.say(
                f"  WARNING: the limb may still be under pressure; close its air supply ({error})"
            )
            self.client.watch(())
            self.client.spin(PORT_VENTS)

    def stop(self) -> None:
        """Stop every node, in the reverse of the order in which they were started."""
        for process in reversed(self.processes.values()):
            process.stop()


# The page of an experiment --------------------------------------------------------------------


@contextlib.contextmanager
def experiment_page(options: Options, progress: Progress) -> Iterator[NodeProcess]:
    """Serve the page, and tell it what the experiment does, until the end of the context.

    The page shows the limb of the options; one that is calibrated on the way is near to it.

    Raises:
        NodeError: it cannot be started, or has ended at once.
        GraphError: it is not ready in time.
    """
    shown = {"limb_file": str(options.limb or ""), **options.load._asdict()}
    setup = GraphSetup(Path(), {}, hardware=options.hardware, planner=shown, page=options.page)
    (spec,) = [each for each in setup.nodes("") if each.executable == "page"]
    parameters = {**spec.parameters, "report": str(options.out / "report")}
    page = NodeProcess(
        spec.package, spec.executable, parameters, options.out / "logs", setup.rig.remap
    )
    with contextlib.ExitStack() as stack:
        stack.callback(page.stop)
        client = stack.enter_context(GraphClient(EXPERIMENT))
        client.watch([page])
        client.wait_ready(["page"])
        url = client.diagnostic_values("page")["url"]
        progress.say(f"the operator's page is at {url}?token={PAGE_TOKEN}")
        DiagnosticsPublisher(
            client.node, lambda: Health("error" if progress.failed else "ok", progress.newest)
        )
        client.watch(())
        ended = threading.Event()
        arguments = (client, ended)
        speaker = threading.Thread(target=_speak, args=arguments, name=EXPERIMENT, daemon=True)
        speaker.start()
        stack.callback(speaker.join, 1.0)
        stack.callback(ended.set)
        yield page


def _speak(client: GraphClient, ended: threading.Event) -> None:
    """Serve the node until the end: it says once a second what the experiment does."""
    with contextlib.suppress(ExternalShutdownException):
        while not ended.is_set():
            client.spin(0.1)
