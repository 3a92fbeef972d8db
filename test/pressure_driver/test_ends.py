"""Every way in which the driver can end: the limb is vented, or it is said that it may not be."""

import contextlib
import os
import pty
import signal
import subprocess
import time
import uuid
from pathlib import Path

import numpy as np
import pytest
from driver_bench import difference

from der_msgs.msg import PressureSetpoint
from der_planner.experiment.processes import find_executable

pytestmark = pytest.mark.graph


def test_every_exit_vents(bench):
    run = bench()
    for number in (signal.SIGTERM, signal.SIGQUIT):
        run.pressurise()
        run.client.watch([run.board])
        run.driver.signal(number)
        run.wait(lambda: not run.driver.alive, "the end of the driver")
        assert run.driver.exit_code == 0
        run.wait(run.vented, "vented chambers")
        assert np.ptp(difference(run.commands[-1])) == 0.0
        run.start_driver()


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


def test_an_exception_vents(bench):
    run = bench()
    with run.other_driver(CRASHING) as process:
        run.pressurise()
        run.publisher.publish(PressureSetpoint(plan_id="crash"))
        run.wait(lambda: process.poll() is not None, "the end of the driver")
        assert process.returncode == 1
        assert b"a callback failed" in process.stderr.read()
        run.wait(run.vented, "vented chambers")


def start_on_terminal(run):
    """Start the driver in the foreground of a pseudo-terminal of its own, as in a window."""
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
    run = bench()
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
    run.wait(run.vented, "vented chambers")
    assert np.ptp(difference(run.commands[-1])) == 0.0


def test_a_signal_while_a_node_is_being_loaded_ends_it_without_a_word(graph):
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
        node = graph.start("pressure_driver", "board_emulator", name=f"board_{number}")
        status = f"/proc/{node.pid}/status"

        def caught(bit=1 << number - 1, status=status):
            with contextlib.suppress(OSError):
                masks = dict(line.split(":", 1) for line in Path(status).read_text().splitlines())
                return int(masks["SigCgt"], 16) & bit

        # Python itself catches SIGINT from the start; the others only once the node's entry runs.
        deadline = time.monotonic() + 90.0
        while not (caught(1 << signal.SIGHUP - 1) and caught()):
            assert time.monotonic() < deadline
            time.sleep(0.001)
        node.signal(number)
        while node.alive:
            assert time.monotonic() < deadline, "it does not end"
            time.sleep(0.01)
        assert node.exit_code == 0, node.last_words()
        assert "Traceback" not in node.log.read_text()


@pytest.mark.parametrize("nohup", [False, True])
def test_signals_that_come_again_change_nothing_and_nohup_is_respected(graph, nohup):
    link = f"/tmp/der_limb_board_test_{uuid.uuid4().hex[:8]}"
    command = [str(find_executable("pressure_driver", "board_emulator")), "--ros-args"]
    process = subprocess.Popen(
        [*(["nohup"] if nohup else []), *command, "-p", f"port_link:={link}"],
        env={**os.environ, "ROS_DOMAIN_ID": str(graph.domain_id)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        graph.client.wait_ready(["board_emulator"])
        if nohup:
            process.send_signal(signal.SIGHUP)
            graph.client.spin(1.0)
            assert process.poll() is None
        while process.poll() is None:
            process.send_signal(signal.SIGINT)
            time.sleep(0.002)
        assert process.returncode == 0
    finally:
        process.kill()
        process.wait()
