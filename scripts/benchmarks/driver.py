"""How punctual the pressure driver is, seen from the board: in quiet, and in a storm."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rclpy.publisher import Publisher
from std_srvs.srv import Trigger

from benchmarks import show
from der_msgs.msg import ChamberPressures, PressureSetpoint, PressureState
from der_planner.experiment.client import GraphClient
from der_planner.experiment.console import Progress
from der_planner.experiment.graph_run import RunningGraph
from der_planner.experiment.processes import GraphSetup, NodeSpec
from limb_interfaces import qos, topics
from limb_interfaces.stamps import nanoseconds, stamp_from_nanoseconds

PERIOD = 50_000_000
LATE = 10e-3
"""[s] after its stamp, a setpoint that reaches the board counts as late."""
PRESSES = 200
"""Of `vent` in the storm."""


class Rig:
    """Nodes that run until a stack ends, and what board and driver have said meanwhile.

    Args:
        stack: ends the nodes.
        nodes: with the emulated board.
        folder: of their logs.
    """

    def __init__(self, stack: contextlib.ExitStack, nodes: list[NodeSpec], folder: Path) -> None:
        self.client = stack.enter_context(GraphClient("benchmark"))
        self.commands: list[ChamberPressures] = []
        self.states: list[PressureState] = []
        subscribe = self.client.subscribe
        subscribe(ChamberPressures, topics.TWIN_BOARD_COMMANDS, qos.SETPOINTS, self.commands.append)
        subscribe(PressureState, topics.PRESSURE_STATE, qos.STATES, self.states.append)
        self.graph = RunningGraph(self.client, Progress())
        stack.callback(self.graph.stop)
        self.graph.start(nodes, folder, {})

    def setpoint_publisher(self) -> Publisher[PressureSetpoint]:
        """Return what publishes setpoints, once the driver listens to it."""
        create = self.client.node.create_publisher
        publisher = create(PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINTS)
        self.client.wait_for(publisher.get_subscription_count, 60.0, "the driver to listen")
        return publisher


Setpoints = dict[int, tuple[float, ...]]
"""Stamp [ns] -> differential pressures [Pa]."""


NODE = """
import time, rclpy
rclpy.init()
node = rclpy.create_node(f"passer_by_{time.time_ns()}")
time.sleep(3.0)
"""


@contextlib.contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """Let processes compute without rest beside everything else."""
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


@contextlib.contextmanager
def _passing_nodes() -> Iterator[None]:
    """Have a node a second appear, each for some seconds."""
    end, running = threading.Event(), []

    def appear() -> None:
        while not end.wait(1.0):
            running.append(subprocess.Popen([sys.executable, "-c", NODE]))

    thread = threading.Thread(target=appear)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()
        for process in running:
            process.kill()
            process.wait()


def _press(rig: Rig, count: int) -> list[float]:
    """Press `vent` under a small command; return the times [s] until it is on the wire."""
    client = rig.client
    publisher = rig.setpoint_publisher()
    vent = client.node.create_client(Trigger, "pressure_driver/vent")
    client.wait_for(vent.service_is_ready, 20.0, "the service")

    def pressed(since: int) -> float | None:
        for command in rig.commands[since:]:
            if abs(command.pressure[0] - command.pressure[1]) < 1.0:
                return nanoseconds(command.header.stamp) / 1e9
        return None

    def commanded() -> bool:
        publisher.publish(PressureSetpoint(plan_id=plan, differential_pressure=[300.0, 0.0]))
        client.spin(0.03)
        newest = rig.commands[-1].pressure
        return bool(newest[0] - newest[1] > 200.0)

    times = []
    for press in range(count):
        plan = f"press {press}"
        rig.graph.arm(60.0)
        client.wait_for(commanded, 60.0, "the command on the wire")
        since = len(rig.commands)
        begin = time.time()
        vent.call_async(Trigger.Request())
        client.wait_for(lambda since=since: pressed(since), 20.0, "the vent on the wire")
        times.append((pressed(since) or 0.0) - begin)
    return times


def play(
    client: GraphClient,
    publisher: Publisher[PressureSetpoint],
    count: int,
    shape: Callable[[int], tuple[float, ...]],
    plan_id: str,
) -> Setpoints:
    """Publish so many setpoints, each 0.2 s ahead as the planner does; return them."""
    start = (time.time_ns() // PERIOD + 10) * PERIOD
    wanted: Setpoints = {}
    for index in range(count):
        stamp = start + index * PERIOD
        while time.time_ns() < stamp - 200_000_000:
            client.spin(0.005)
        wanted[stamp] = shape(index)
        message = PressureSetpoint(
            plan_id=plan_id, index=index, differential_pressure=list(wanted[stamp])
        )
        message.header.stamp = stamp_from_nanoseconds(stamp)
        publisher.publish(message)
    return wanted


def _slow_motion(index: int) -> tuple[float, float]:
    """Return never twice the same pair [Pa], so that each can be told on the wire."""
    phase = 2.0 * np.pi * index * PERIOD / 20e9
    return 6000.0 * (1.0 - np.cos(phase)) + 50.0 + 0.1 * index, -4000.0 - 2.0 * index


@dataclass
class Samples:
    """What one playing of a case has shown; times in s."""

    setpoints: int
    latency: list[float]
    """From a setpoint's stamp to its first byte at the board."""
    late_at_driver: int
    ticks: dict[str, float] = field(default_factory=dict)
    """Percentiles [ms] of the driver's own ticks, on its own clock."""
    real_time_priority: str = ""
    presses: list[float] = field(default_factory=list)
    """From a press of `vent` to its first byte at the board [s]."""
    lost: int = 0
    """1 if the run ended or was vented."""


def _compare(wanted: Setpoints, rig: Rig) -> Samples:
    """Compare what was asked with what the board received, on the board's clock."""
    by_tick: dict[int, ChamberPressures] = {}
    for command in rig.commands:
        by_tick.setdefault(nanoseconds(command.header.stamp) // PERIOD * PERIOD, command)
    latency = []
    for stamp, values in wanted.items():
        command = by_tick.get(stamp)
        if command is None:
            continue
        pressure = np.array(command.pressure)
        if np.abs(pressure[0::2] - pressure[1::2] - values).max() < 1.5:
            latency.append((nanoseconds(command.header.stamp) - stamp) / 1e9)
    return Samples(len(wanted), latency, rig.states[-1].setpoints_late)


def _figures(case: str, played: list[Samples]) -> dict[str, float | str]:
    """Return the figures of a case from all its playings together."""
    latency = np.array([value for each in played for value in each.latency])
    count = sum(each.setpoints for each in played)
    figures: dict[str, float | str] = {
        f"{case}_setpoints": float(count),
        f"{case}_setpoints_not_received_at_their_tick": float(count - len(latency)),
        f"{case}_setpoints_over_10_ms_late": float(np.sum(latency > LATE)),
        f"{case}_setpoints_late_at_the_driver": float(sum(each.late_at_driver for each in played)),
    }
    figures |= _percentiles(f"{case}_stamp_to_first_byte", latency)
    figures[f"{case}_runs_ended_or_vented"] = float(sum(each.lost for each in played))
    if presses := [value for each in played for value in each.presses]:
        figures[f"{case}_vent_presses"] = float(len(presses))
        figures |= _percentiles(f"{case}_vent_press_to_first_byte", np.array(presses))
    for name in played[0].ticks:
        figures[f"{case}_{name}"] = float(np.median([each.ticks[name] for each in played]))
    if played[0].real_time_priority:
        figures[f"{case}_real_time_priority"] = played[0].real_time_priority
    return figures


def _percentiles(name: str, values: NDArray[np.float64]) -> dict[str, float | str]:
    shares = {"p50": 50, "p99": 99, "max": 100}
    return {
        f"{name}_{key}_ms": float(np.percentile(values, share) * 1000.0)
        for key, share in shares.items()
    }


def _measure(case: str, seconds: float, presses: int) -> Samples:
    """Play setpoints to an emulated board and return what was seen."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="der_limb_driver_")))
        board_and_driver = GraphSetup(folder / "bag", {}).nodes(str(folder / "board"))[:2]
        rig = Rig(stack, board_and_driver, folder)
        client = rig.client
        client.call("pressure_driver/arm")
        if case == "storm":
            stack.enter_context(busy_loops(os.cpu_count() or 1))
            stack.enter_context(_passing_nodes())
        publisher, count = rig.setpoint_publisher(), round(seconds * 1e9 / PERIOD)
        wanted = play(client, publisher, count, _slow_motion, "benchmark")
        client.spin(0.5)
        samples = _compare(wanted, rig)
        client.spin(1.1)
        told = client.diagnostic_values("pressure_driver")
        samples.ticks = {k: float(v) for k, v in told.items() if k.startswith("tick_to_")}
        samples.real_time_priority = told.get("real_time_priority", "unknown")
        bad = (PressureState.FAULT, PressureState.DISARMED)
        lost = [s for s in rig.states if s.setpoints_accepted and s.mode in bad]
        samples.lost = int(bool(lost))
        if lost:
            print(f"driver: vented: {'; '.join(lost[0].faults)}", file=sys.stderr)
        if case == "storm":
            client.call("pressure_driver/vent", 20.0)
            samples.presses = _press(rig, presses)
        return samples


CASES = {
    "quiet": (3, "driver and board"),
    "storm": (8, "every core busy, and a node a second appearing"),
}
"""How often each is played, and what it is."""


def run(quick: bool) -> dict[str, float | str]:
    """Measure both cases; ``quick`` plays each once for 10 s in place of several minutes."""
    figures: dict[str, float | str] = {}
    for case, (usual, what) in CASES.items():
        runs, seconds, presses = (1, 10.0, 20) if quick else (usual, 60.0, PRESSES)
        print(f"driver: {what}, {runs} x {seconds:.0f} s …", file=sys.stderr, flush=True)
        found = _figures(case, [_measure(case, seconds, presses // runs) for _ in range(runs)])
        show(found)
        figures |= found
    return figures
