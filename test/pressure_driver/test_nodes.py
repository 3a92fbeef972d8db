"""The driver and the emulated board as running nodes on a pseudo-terminal: runs, faults, exits."""

import contextlib
import os
import pty
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import numpy as np
import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from std_msgs.msg import Float64MultiArray

from der_msgs.msg import ChamberPressures, PressureSetpoint, PressureState
from limb_interfaces import qos, topics
from limb_interfaces.stamps import nanoseconds, stamp_from_nanoseconds

pytestmark = pytest.mark.graph

PERIOD = 50_000_000
VENTED = 500.0
"""[Pa] gauge that counts as vented."""
QUICK = {
    "follow_time": 0.6,
    "follow_tolerance": 1500.0,
    "hold_time": 0.3,
    "slowest_fill": 6000.0,
    "slowest_vent": 1.5,
}
"""Bounds tighter than the defaults, so that the tests are short."""


class Bench:
    """A driver and an emulated board in the test's graph, seen through their topics only."""

    def __init__(self, graph, protocol="ezloop", **parameters):
        self.graph = graph
        self.client = graph.client
        self.link = f"/tmp/der_limb_board_test_{uuid.uuid4().hex[:8]}"
        self.states, self.air, self.commands = [], [], []
        self.looked_at = 0
        self.client.subscribe(PressureState, topics.PRESSURE_STATE, qos.STATES, self.states.append)
        self.client.subscribe(
            ChamberPressures, topics.TWIN_CHAMBER_PRESSURES, qos.STATES, self.air.append
        )
        self.client.subscribe(
            ChamberPressures, topics.TWIN_BOARD_COMMANDS, qos.SETPOINTS, self.commands.append
        )
        self.publisher = self.client.node.create_publisher(
            PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINTS
        )
        self.board = graph.start(
            "pressure_driver", "board_emulator", port_link=self.link, protocol=protocol
        )
        self.client.watch([self.board])
        self.client.wait_ready(["board_emulator"])
        self.parameters = {"port": self.link, "protocol": protocol, **QUICK, **parameters}
        self.start_driver()

    def start_driver(self, ready=True):
        self.driver = self.graph.start("pressure_driver", "pressure_driver", **self.parameters)
        if ready:
            self.client.watch([self.board, self.driver])
            self.client.diagnostics.pop("pressure_driver", None)
            self.client.wait_ready(["pressure_driver"])
            self.wait(self.publisher.get_subscription_count, "the driver's subscription")
            self.wait(lambda: self.air, "the air")

    def wait(self, condition, what, limit=30.0):
        return self.client.wait_for(condition, limit, what)

    @property
    def mode(self):
        return self.states[-1].mode if self.states else -1

    def wait_mode(self, mode, limit=30.0):
        """Wait for a mode, even if it has been left again before anybody looked."""

        def seen():
            later = self.states[self.looked_at :]
            return any(state.mode == mode for state in later)

        self.wait(seen, f"mode {mode}, now {self.mode}", limit)
        while self.states[self.looked_at].mode != mode:
            self.looked_at += 1

    def gauge(self):
        """True gauge pressures from the newest message of the air; the lowest chamber is vented."""
        pressure = np.array(self.air[-1].pressure)
        return pressure - self.rest

    def vented(self):
        return self.gauge().max() < VENTED

    def arm(self):
        def try_to_arm():
            with contextlib.suppress(Exception):
                return self.client.call("pressure_driver/arm", 20.0)

        self.rest = np.array(self.air[-1].pressure)
        self.wait(try_to_arm, "the driver to arm", 40.0)

    def play(self, count, shape):
        """Publish setpoints 0.2 s ahead in real time; return stamp -> differential pressures."""
        start = (time.time_ns() // PERIOD + 8) * PERIOD
        plan_id = uuid.uuid4().hex  # a plan belongs to one arming
        wanted = {}
        for index in range(count):
            stamp = start + index * PERIOD
            while time.time_ns() < stamp - 200_000_000:
                self.client.spin(0.004)
            message = PressureSetpoint(
                plan_id=plan_id, index=index, differential_pressure=list(shape(index))
            )
            message.header.stamp = stamp_from_nanoseconds(stamp)
            self.publisher.publish(message)
            wanted[stamp] = shape(index)
        return wanted

    def pressurise(self):
        """Arm and play until a chamber is full; a machine that stalls may need several turns."""
        self.arm()
        deadline = time.monotonic() + 40.0
        while self.gauge().max() < 2000.0:
            assert time.monotonic() < deadline, "no pressure in any chamber"
            self.play(8, lambda k: (min(900.0 * (k + 1), 3500.0), -min(500.0 * (k + 1), 2000.0)))

    def have(self, faults):
        """Tell the emulated board to have these faults and no others."""
        node = self.client.node
        service = node.create_client(SetParameters, "board_emulator/set_parameters")
        self.wait(service.service_is_ready, "the emulator's parameter service")
        value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=faults)
        future = service.call_async(
            SetParameters.Request(parameters=[Parameter(name="faults", value=value)])
        )
        self.wait(future.done, "the emulator to take its faults")
        assert future.result().results[0].successful, future.result().results[0].reason
        node.destroy_client(service)


@pytest.fixture
def bench(graph):
    return lambda *arguments, **parameters: Bench(graph, *arguments, **parameters)


def difference(command):
    pressure = np.array(command.pressure)
    return pressure[0::2] - pressure[1::2]


@pytest.mark.parametrize("protocol", ["ezloop", "ctrlp", "native"])
def test_a_run_from_arming_to_the_end_of_the_process(bench, protocol):
    run = bench(protocol)
    assert run.mode in (-1, PressureState.DISARMED)
    run.arm()
    wanted = run.play(24, lambda k: (200.0 * (k + 1), -100.0 * (k + 1)))
    # Setpoints stop: hold, ramp down, vented.
    run.wait_mode(PressureState.HOLDING)
    run.wait_mode(PressureState.VENTING)
    run.wait_mode(PressureState.ARMED)
    run.wait(run.vented, "vented chambers")
    assert nanoseconds(run.air[-1].header.stamp) - max(wanted) < 8_000_000_000
    state = run.states[-1]
    counters = (
        state.setpoints_accepted,
        state.setpoints_late + state.setpoints_duplicate + state.setpoints_refused,
    )
    received = {}
    for command in run.commands:
        key = tuple(np.round(difference(command), -1))
        received.setdefault(key, nanoseconds(command.header.stamp))
    # A machine that stalls for seconds may make setpoints late; none may then be played.
    assert sum(counters) == len(wanted)
    in_time = [
        received[key] - stamp
        for stamp, u in wanted.items()
        if (key := tuple(np.round(u, -1))) in received
    ]
    assert len(in_time) >= 1
    assert min(in_time) >= 0
    assert state.bytes_sent > 1000
    assert state.bytes_received > 1000
    if protocol == "ezloop":
        assert np.isnan(state.round_trip)
    else:
        run.wait(lambda: run.states[-1].round_trip > 0.0, "the echo of a command")
    assert np.isfinite(state.supply_pressure) == (protocol != "ctrlp")
    assert run.client.call("pressure_driver/vent")
    run.wait_mode(PressureState.DISARMED)
    assert run.vented()
    ticks = [nanoseconds(s.header.stamp) for s in run.states]
    assert all(tick % PERIOD == 0 for tick in ticks if tick)
    assert ticks == sorted(ticks)
    assert run.driver.stop() == 0
    assert run.board.stop() == 0
    assert not os.path.lexists(run.link)


FAULTS = [
    ("mute", "no telemetry", 4.0),
    ("stick:0", "does not follow", 6.0),
    ("runaway:1", "over-pressure|does not follow", 6.0),
    ("supply:105000", "supply too low", 5.0),
    ("supply:290000", "supply too high", 5.0),
    ("unplug:0.5", "serial link lost", 5.0),
]


def test_every_fault_of_the_board_ends_vented(bench):
    """From the fault to chambers that are down, within the stated seconds of the board's air."""
    run = bench()
    took = {}
    for fault, reason, limit in FAULTS:
        run.pressurise()
        run.have(fault)
        begin = time.monotonic()
        # To the other side, so that a valve which does not move is noticed.
        while run.mode != PressureState.FAULT:
            assert time.monotonic() - begin < 30.0, f"{fault} was not noticed"
            run.play(10, lambda _: (-3500.0, -2000.0))
        assert any(part in " ".join(run.states[-1].faults) for part in reason.split("|"))
        noticed = nanoseconds(run.states[-1].header.stamp)
        if fault.startswith(("stick", "runaway")):
            # What is broken cannot vent; everything else is told to.
            run.wait(lambda: np.ptp(difference(run.commands[-1])) == 0.0, "vent commands")
            run.have("")
        run.wait(run.vented, f"vented chambers after {fault}", 30.0)
        down = nanoseconds(run.air[-1].header.stamp)
        took[fault] = (down - noticed) / 1e9
        assert took[fault] < limit, took
        assert run.mode == PressureState.FAULT
        run.have("")
    assert run.driver.stop() == 0


def test_every_exit_vents(bench):
    run = bench()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        run.pressurise()
        run.client.watch([run.board])
        run.driver.signal(number)
        run.wait(lambda: not run.driver.alive, "the end of the driver")
        assert run.driver.exit_code == 0
        run.wait(run.vented, "vented chambers", 15.0)
        assert np.ptp(difference(run.commands[-1])) == 0.0
        run.start_driver()


@pytest.mark.parametrize("guardian", ["auto", "never"])
def test_a_killed_driver_leaves_boards_without_a_watchdog_vented_if_it_has_a_guardian(
    bench, guardian
):
    run = bench(guardian=guardian)
    run.pressurise()
    run.client.watch([run.board])
    run.driver.signal(signal.SIGKILL)
    run.wait(lambda: not run.driver.alive, "the end of the driver")
    if guardian == "never":
        run.client.spin(1.0)
        assert not run.vented()
        run.start_driver(ready=False)
    run.wait(run.vented, "vented chambers", 30.0)


def test_a_stopped_driver_is_ended_and_the_board_vented(bench):
    run = bench()
    run.pressurise()
    run.client.watch([run.board])
    run.driver.signal(signal.SIGSTOP)
    run.wait(lambda: not run.driver.alive, "the end of the driver")
    assert run.driver.exit_code == -signal.SIGKILL
    run.wait(run.vented, "vented chambers", 15.0)


def test_an_end_without_the_board_says_so(bench):
    run = bench()
    run.pressurise()
    run.have("unplug")
    run.wait_mode(PressureState.FAULT)
    run.client.watch([run.board])
    assert run.driver.stop() == 1
    assert "cannot be reached" in run.driver.last_words()
    assert "close the air supply" in run.driver.last_words()
    assert "vented and closed" not in run.driver.log.read_text()


def test_a_killed_driver_leaves_native_boards_vented(bench):
    run = bench("native")
    run.pressurise()
    run.client.watch([run.board])
    run.driver.signal(signal.SIGKILL)
    run.wait(lambda: not run.driver.alive, "the end of the driver")
    run.wait(run.vented, "vented chambers", 15.0)


CRASHING = """
import rclpy
from pressure_driver.node import PressureDriver
from limb_interfaces.runner import run_node

class Crashing(PressureDriver):
    def _on_setpoint(self, message, info):
        if message.plan_id == "crash":
            raise RuntimeError("a callback failed")
        super()._on_setpoint(message, info)

raise SystemExit(run_node(Crashing))
"""


def test_an_exception_vents(bench, tmp_path):
    run = bench()
    run.driver.stop()
    run.client.watch([run.board])
    arguments = ["--ros-args", "-p", f"port:={run.link}"]
    environment = {**os.environ, "ROS_DOMAIN_ID": str(run.graph.domain_id)}
    process = subprocess.Popen(
        [sys.executable, "-c", CRASHING, *arguments], env=environment, stderr=subprocess.PIPE
    )
    try:
        run.states.clear()
        run.wait(lambda: run.states, "the driver")
        run.wait(run.publisher.get_subscription_count, "the driver's subscription")
        run.pressurise()
        run.publisher.publish(PressureSetpoint(plan_id="crash"))
        run.wait(lambda: process.poll() is not None, "the end of the driver")
        assert process.returncode == 1
        assert b"a callback failed" in process.stderr.read()
        run.wait(run.vented, "vented chambers", 15.0)
    finally:
        process.kill()
        process.wait()


def test_cmd_u_t_is_taken_in_hectopascal(bench):
    run = bench(accept_cmd_u_t=True)
    run.arm()
    publisher = run.client.node.create_publisher(Float64MultiArray, "cmd_u_t", qos.SETPOINTS)
    run.wait(publisher.get_subscription_count, "the driver's subscription")

    def commanded():
        publisher.publish(Float64MultiArray(data=[12.0, -34.0]))
        return run.commands and difference(run.commands[-1]) == pytest.approx([1200.0, -3400.0])

    run.wait(commanded, "the command on the wire")
    assert run.states[-1].plan_id in ("", "cmd_u_t")


def refused(process, *words):
    deadline = time.monotonic() + 60.0
    while process.alive and time.monotonic() < deadline:
        time.sleep(0.05)
    assert process.exit_code == 1, process.last_words()
    for word in words:
        assert word in process.last_words(), process.last_words()


def test_what_cannot_work_is_refused_at_the_start(graph, bench):
    missing = graph.start("pressure_driver", "pressure_driver", name="a", port="/dev/ttyNOWHERE")
    contradiction = graph.start("pressure_driver", "pressure_driver", name="b", over_pressure=2e4)
    protocol = graph.start("pressure_driver", "pressure_driver", name="c", protocol="modbus")
    limit = graph.start("pressure_driver", "pressure_driver", name="d", pressure_limit=-5.0)
    link = f"/tmp/der_limb_board_test_{uuid.uuid4().hex[:8]}"
    fault = graph.start("pressure_driver", "board_emulator", name="e", faults="jam", port_link=link)
    refused(missing, "/dev/ttyNOWHERE", "ports that exist", "'port'")
    refused(contradiction, "over_pressure", "pressure_limit")
    refused(protocol, "protocol", "ezloop, ctrlp, native")
    refused(limit, "pressure_limit")
    refused(fault, "jam", "stick:CHAMBER")
    assert not os.path.lexists(link)
    run = bench()
    second = graph.start("pressure_driver", "pressure_driver", name="second", port=run.link)
    refused(second, run.link, "in use", "fuser")
    run.driver.check()


def start_on_terminal(run):
    """Start the driver in the foreground of a pseudo-terminal of its own, as in a window."""
    from der_planner.experiment.processes import find_executable

    command = [str(find_executable("pressure_driver", "pressure_driver")), "--ros-args"]
    for name, value in run.parameters.items():
        command += ["-p", f"{name}:={value}"]
    process, terminal = pty.fork()
    if process == 0:
        os.environ["ROS_DOMAIN_ID"] = str(run.graph.domain_id)
        os.execv(command[0], command)
    return process, terminal


def test_a_closed_terminal_vents(bench):
    """The kernel sends SIGHUP to the driver, and everything that it writes from then on fails."""
    run = bench(guardian="never")
    assert run.driver.stop() == 0
    run.client.watch([run.board])
    run.states.clear()
    process, terminal = start_on_terminal(run)
    try:
        run.wait(lambda: run.states, "the driver")
        run.wait(run.publisher.get_subscription_count, "the driver's subscription")
        run.pressurise()
        os.close(terminal)
        run.wait(lambda: os.waitpid(process, os.WNOHANG)[0], "the end of the driver")
    finally:
        with contextlib.suppress(OSError):
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
    run.wait(run.vented, "vented chambers", 15.0)
    assert np.ptp(difference(run.commands[-1])) == 0.0


@pytest.mark.parametrize(
    ("package", "executable"),
    [
        ("pressure_driver", "pressure_driver"),
        ("pressure_driver", "board_emulator"),
        ("der_planner", "planner"),
        ("der_planner", "recorder"),
        ("apriltag_tracker", "apriltag_tracker"),
    ],
)
def test_a_signal_while_a_node_is_being_loaded_ends_it_without_a_word(graph, package, executable):
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
        node = graph.start(package, executable, name=f"{executable}_{number}")
        status = f"/proc/{node.pid}/status"

        def caught(bit=1 << number - 1, status=status):
            with contextlib.suppress(OSError):
                masks = dict(line.split(":", 1) for line in Path(status).read_text().splitlines())
                return int(masks["SigCgt"], 16) & bit

        # Python itself catches SIGINT from the start; SIGHUP only once the node's entry runs.
        deadline = time.monotonic() + 30.0
        while not caught(1 << signal.SIGHUP - 1):
            assert time.monotonic() < deadline
            time.sleep(0.001)
        node.signal(number)
        while node.alive:
            assert time.monotonic() < deadline, "it does not end"
            time.sleep(0.01)
        assert node.exit_code == 0, node.last_words()
        assert "Traceback" not in node.log.read_text()
