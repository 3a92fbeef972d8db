"""How punctual the pressure driver is, seen from the board: quiet, busy, in the whole graph."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from der_msgs.msg import (
    ChamberPressures,
    MotionCommand,
    PressurePlan,
    PressureSetpoint,
    PressureState,
)
from der_planner.experiment.client import GraphClient
from der_planner.experiment.processes import NodeProcess
from limb_interfaces import qos, topics
from limb_interfaces.stamps import nanoseconds, stamp_from_nanoseconds

PERIOD = 50_000_000
LATE = 10e-3
"""[s] after its stamp, a setpoint that reaches the board counts as late."""
GUARDED = ("quiet", "alone")
"""The case with the guardian, and the same without."""
TURNS = 6
"""Starts of each of these two. When the board reports, relative to the driver's ticks, is drawn at
each start, and a report that comes just before a tick delays it."""


@dataclass
class Seen:
    """What the benchmark has heard while one case ran."""

    commands: list[ChamberPressures] = field(default_factory=list)
    states: list[PressureState] = field(default_factory=list)


Setpoints = dict[int, tuple[float, ...]]
"""Stamp [ns] -> differential pressures [Pa]."""


def _nodes(case: str, port: str, folder: Path) -> list[tuple[str, str, dict[str, object]]]:
    board = ("pressure_driver", "board_emulator", {"port_link": port})
    options: dict[str, object] = {"real_time_priority": 0} if case == "ordinary" else {}
    if case in GUARDED:
        options["guardian"] = "always" if case == GUARDED[0] else "never"
    driver = ("pressure_driver", "pressure_driver", {"port": port, **options})
    if case != "graph":
        return [board, driver]
    return [
        board,
        driver,
        ("der_planner", "limb_twin", {}),
        ("apriltag_tracker", "synthetic_camera", {}),
        ("apriltag_tracker", "apriltag_tracker", {}),
        ("der_planner", "planner", {}),
        ("der_planner", "recorder", {"output": str(folder / "bag")}),
    ]


@contextlib.contextmanager
def _burners(count: int) -> Iterator[None]:
    """Keep cores busy with processes that never sleep."""
    running = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


def _stream(client: GraphClient, seconds: float) -> Setpoints:
    """Publish a slow motion 0.2 s ahead, as the planner does."""
    publisher = client.node.create_publisher(
        PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINTS
    )
    client.wait_for(publisher.get_subscription_count, 20.0, "the driver to listen")
    start = (time.time_ns() // PERIOD + 10) * PERIOD
    wanted: Setpoints = {}
    for index in range(round(seconds * 1e9 / PERIOD)):
        stamp = start + index * PERIOD
        while time.time_ns() < stamp - 200_000_000:
            client.spin(0.005)
        phase = 2.0 * np.pi * index * PERIOD / 20e9
        # Never twice the same pair, so that each can be told from the others on the wire.
        values = (6000.0 * (1.0 - np.cos(phase)) + 50.0 + 0.1 * index, -4000.0 - 2.0 * index)
        message = PressureSetpoint(
            plan_id="benchmark", index=index, differential_pressure=list(values)
        )
        message.header.stamp = stamp_from_nanoseconds(stamp)
        publisher.publish(message)
        wanted[stamp] = values
    client.spin(0.5)
    return wanted


def play_plan(client: GraphClient, seconds: float) -> Setpoints:
    """Have the planner plan and play a motion of at least this length."""
    client.subscribe(PressurePlan, topics.PLAN, qos.LATCHED)
    client.call("recorder/start", 20.0)
    publisher = client.node.create_publisher(MotionCommand, topics.COMMAND, qos.COMMANDS)
    client.wait_for(publisher.get_subscription_count, 20.0, "the planner to listen")
    cycles = int(np.ceil(seconds / 20.0))
    publisher.publish(
        MotionCommand(
            motion="same_direction", model="der", period=20.0, cycles=cycles, plan_id="benchmark"
        )
    )
    plan = client.wait_for(lambda: client.newest.get(topics.PLAN), 180.0, "the plan")
    start = nanoseconds(plan.header.stamp)
    values = np.reshape(plan.differential_pressure, (len(plan.time), -1))
    stamps = [start + round(t * 1e9) for t in plan.time]
    client.wait_for(lambda: time.time_ns() > stamps[-1] + 500_000_000, 300.0, "the motion's end")
    return {stamp: tuple(row) for stamp, row in zip(stamps, values.tolist(), strict=True)}


@dataclass
class Samples:
    """What one playing of a case has shown; times in s."""

    setpoints: int
    latency: list[float]
    """From a setpoint's stamp to its first byte at the board."""
    jitter: list[float]
    """Of the intervals between first bytes."""
    late_at_driver: int
    processor: dict[str, float] = field(default_factory=dict)
    """Per cent of one core, by the node's name."""
    ticks: dict[str, float] = field(default_factory=dict)
    """Percentiles [ms] of the driver's own ticks, on its own clock."""
    real_time_priority: str = ""

    def first_byte(self, share: str) -> float:
        """Return p50 or p99 [ms] of the latency on the board's clock."""
        return float(1000.0 * np.percentile(self.latency, int(share[1:])))

    def write(self, share: str) -> float:
        """Return p50 or p99 [ms] from a tick to the end of its write, on the driver's clock."""
        return self.ticks[f"tick_to_write_{share}_ms"]


def _compare(wanted: Setpoints, seen: Seen) -> Samples:
    """Compare what was asked with what the board received, on the board's clock."""
    by_tick: dict[int, ChamberPressures] = {}
    for command in seen.commands:
        by_tick.setdefault(nanoseconds(command.header.stamp) // PERIOD * PERIOD, command)
    latency, stamps = [], []
    for stamp, values in wanted.items():
        command = by_tick.get(stamp)
        if command is None:
            continue
        pressure = np.array(command.pressure)
        if np.abs(pressure[0::2] - pressure[1::2] - values).max() < 1.5:
            stamps.append(nanoseconds(command.header.stamp))
            latency.append((stamps[-1] - stamp) / 1e9)
    interval = np.diff(stamps) / 1e9
    jitter = np.abs(interval[interval < 1.5 * PERIOD / 1e9] - PERIOD / 1e9)
    return Samples(len(wanted), latency, jitter.tolist(), seen.states[-1].setpoints_late)


def _figures(case: str, played: list[Samples]) -> dict[str, float | str]:
    """Return the figures of a case from all its playings together."""
    latency = np.array([value for each in played for value in each.latency])
    jitter = np.array([value for each in played for value in each.jitter])
    count = sum(each.setpoints for each in played)
    figures: dict[str, float | str] = {
        f"{case}_setpoints": float(count),
        f"{case}_setpoints_not_received_at_their_tick": float(count - len(latency)),
        f"{case}_setpoints_over_10_ms_late": float(np.sum(latency > LATE)),
        f"{case}_setpoints_late_at_the_driver": float(sum(each.late_at_driver for each in played)),
    }
    figures |= _percentiles(f"{case}_stamp_to_first_byte", latency)
    figures |= _percentiles(f"{case}_tick_jitter", jitter)
    for name in played[0].processor:
        mean = float(np.mean([each.processor[name] for each in played]))
        figures[f"{case}_cpu_{name}_percent"] = mean
    for name in played[0].ticks:
        figures[f"{case}_{name}"] = float(np.median([each.ticks[name] for each in played]))
    if played[0].real_time_priority:
        figures[f"{case}_real_time_priority"] = played[0].real_time_priority
    return figures


def evaluate(case: str, wanted: Setpoints, seen: Seen) -> dict[str, float | str]:
    """Return the figures of one playing of a case."""
    return _figures(case, [_compare(wanted, seen)])


def _percentiles(name: str, values: NDArray[np.float64]) -> dict[str, float | str]:
    shares = {"p50": 50, "p99": 99, "max": 100}
    return {
        f"{name}_{key}_ms": float(np.percentile(values, share) * 1000.0)
        for key, share in shares.items()
    }


def _guardian_cost(turns: dict[str, list[Samples]]) -> dict[str, float | str]:
    """Return what the guardian adds from a setpoint's stamp to the driver's write and to the wire.

    Differences of the medians over all starts. The board's clock is read by a program that shares
    the cores, which shows in its last per cent; the driver's own clock does not see that.
    """
    medians = {
        case: {
            f"{name}_{share}": float(np.median([getattr(each, name)(share) for each in played]))
            for name in ("first_byte", "write")
            for share in ("p50", "p99")
        }
        for case, played in turns.items()
    }
    guarded, alone = (medians[case] for case in GUARDED)
    return {f"guardian_adds_to_{key}_ms": guarded[key] - alone[key] for key in guarded}


def _measure(case: str, seconds: float) -> Samples:
    """Start the nodes of a case, play, and return what was seen."""
    play: Callable[[GraphClient, float], Setpoints] = play_plan if case == "graph" else _stream
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="der_limb_driver_")))
        client = stack.enter_context(GraphClient("benchmark"))
        seen = Seen()
        client.subscribe(
            ChamberPressures, topics.TWIN_BOARD_COMMANDS, qos.SETPOINTS, seen.commands.append
        )
        client.subscribe(PressureState, topics.PRESSURE_STATE, qos.STATES, seen.states.append)
        processes: dict[str, NodeProcess] = {}
        port = str(folder / "board")
        for package, executable, parameters in _nodes(case, port, folder):
            process = NodeProcess(package, executable, parameters, folder)
            processes[executable] = process
            stack.callback(process.stop)
            client.watch(processes.values())
            if executable == "board_emulator":
                client.wait_for(lambda: os.path.lexists(port), 60.0, "the emulated port")
        client.wait_ready(processes)
        client.call("pressure_driver/arm", 20.0)
        if case in ("busy", "ordinary"):
            stack.enter_context(_burners(os.cpu_count() or 1))
        before = {name: process.measure_cpu() for name, process in processes.items()}
        begin = time.monotonic()
        wanted = play(client, seconds)
        wall = time.monotonic() - begin
        samples = _compare(wanted, seen)
        for name, process in processes.items():
            samples.processor[name] = 100.0 * (process.measure_cpu() - before[name]) / wall
        client.spin(1.1)
        told = client.diagnostic_values("pressure_driver")
        samples.ticks = {k: float(v) for k, v in told.items() if k.startswith("tick_to_")}
        samples.real_time_priority = told.get("real_time_priority", "unknown")
        return samples


def run(quick: bool) -> dict[str, float | str]:
    """Measure all cases; ``quick`` takes 10 s each instead of 60.

    With and without the guardian take turns, so that what else the machine does in some seconds
    counts for both.
    """
    seconds = 10.0 if quick else 60.0
    titles = {
        "quiet": "driver, guardian and board",
        "alone": "the same without the guardian",
        "busy": "driver and board, every core busy with another process",
        "ordinary": "the same without real-time priority for the driver",
        "graph": "driver, board and planner, twin, camera, tracker, recorder",
    }
    print(f"driver: with and without the guardian, {seconds:.0f} s each …", file=sys.stderr)
    turns: dict[str, list[Samples]] = {case: [] for case in GUARDED}
    count = 2 if quick else TURNS
    for _ in range(count):
        for case in GUARDED:
            turns[case].append(_measure(case, seconds / count))
    figures: dict[str, float | str] = {}
    for case, title in titles.items():
        if case in GUARDED:
            found = _figures(case, turns[case])
        else:
            print(f"driver: {title}, {seconds:.0f} s …", file=sys.stderr, flush=True)
            found = _figures(case, [_measure(case, seconds)])
        figures |= found
        if case == GUARDED[-1]:
            found |= _guardian_cost(turns)
        figures |= found
        print(f"\n{title}")
        for key, value in found.items():
            shown = f"{value:10.3f}" if isinstance(value, float) else f"{value:>10}"
            print(f"  {key.removeprefix(case + '_').replace('_', ' '):45s} {shown}")
    return figures
