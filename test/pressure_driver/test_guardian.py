"""Drivers as real processes on an emulated board; what their guardian does when they fail."""

import contextlib
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from pressure_driver.emulator.board import EmulatedBoard
from pressure_driver.emulator.faults import Faults
from pressure_driver.emulator.pneumatics import BoardPneumatics
from pressure_driver.emulator.port import EmulatedPort
from pressure_driver.emulator.runner import BoardRunner
from pressure_driver.protocols import board_protocol

pytestmark = pytest.mark.slow

PROMISED = 0.3
"""[s] from the last sign of life to the vent command on the wire."""
ATTEMPTS = 10
"""A busy machine may keep the test's own board waiting: the promise is checked on the best run."""

DRIVER = """
import signal, sys, threading, time
from pressure_driver.core import CoreSettings, DriverCore
from pressure_driver.grid import TickGrid
from pressure_driver.guardian_client import GuardianClient
from pressure_driver.link import SerialLink
from pressure_driver.watch.limits import MonitorLimits
from pressure_driver.protocols import host_protocol
from pressure_driver.schedule import ScheduleLimits, Setpoint

stop, executor_blocked, port_blocked = (threading.Event() for _ in range(3))
signal.signal(signal.SIGTERM, lambda *_: stop.set())
signal.signal(signal.SIGUSR1, lambda *_: port_blocked.set())
signal.signal(signal.SIGUSR2, lambda *_: executor_blocked.set())

class Core(DriverCore):
    def tick(self, instant):
        if port_blocked.is_set():
            time.sleep(3600.0)
        return super().tick(instant)

core = Core(
    host_protocol(sys.argv[2]),
    CoreSettings(monitor=MonitorLimits(rest_time=0.15), schedule=ScheduleLimits(slew_limit=1e6)),
)
guardian = GuardianClient(10)
say = lambda text: print(text, flush=True)
link = SerialLink(sys.argv[1], 115200, TickGrid(50_000_000), core, 10, say, guardian)
link.start()
say(f"guardian {guardian.process_id}")
while not core.arm()[0]:
    guardian.executor_lives()
    time.sleep(0.01)
index = armings = 0
while not stop.is_set():
    if executor_blocked.is_set():
        time.sleep(3600.0)
    guardian.executor_lives()
    index += 1
    stamp = (time.time_ns() // 50_000_000 + 2) * 50_000_000
    core.offer(Setpoint(stamp, (3000.0, -2000.0), f"plan {armings}", index), time.time_ns())
    if core.snapshot().faults:
        say("faults " + "; ".join(core.snapshot().faults))
        while not core.arm()[0] and not stop.is_set():
            guardian.executor_lives()
            time.sleep(0.02)
        armings += 1
    time.sleep(0.05)
link.close()
sys.exit(0 if link.vented_at_end else 1)
"""


def wait_for(condition, what, limit=60.0):
    deadline = time.monotonic() + limit
    while not condition():
        assert time.monotonic() < deadline, f"waited too long for {what}"
        time.sleep(0.002)


class Run:
    """A board in this process, and a driver with its guardian in two others."""

    def __init__(self, folder, protocol):
        self.protocol, self.folder = protocol, folder
        self.commands = []
        self.port = EmulatedPort(str(folder / "board"), 115_200)
        self.board = EmulatedBoard(board_protocol(protocol), BoardPneumatics(2, 1), 1)
        self.runner = BoardRunner(self.board, self.port, on_command=self.commands.append)
        self.runner.start()
        self.driver = None

    def start(self):
        self.log = self.folder / "driver.log"
        self.script = self.folder / "driver.py"
        self.script.write_text(DRIVER)
        with self.log.open("wb") as output:
            self.driver = subprocess.Popen(
                [sys.executable, str(self.script), str(self.port.link), self.protocol],
                stdout=output,
                stderr=subprocess.STDOUT,
            )
        wait_for(self.guardians, "the guardian")
        wait_for(self.pressurised, "pressure in a chamber")

    def pressurised(self):
        assert self.driver.poll() is None, self.log.read_text()
        return max(self.board.pneumatics.pressure) > self.board.pneumatics.atmosphere + 1000.0

    def vented(self):
        return max(self.board.pneumatics.pressure) < self.board.pneumatics.atmosphere + 300.0

    def is_vent(self, command):
        pressure = np.reshape(command.pressure, (-1, 2))
        return float(np.ptp(pressure, axis=1).max()) == 0.0

    def guardians(self):
        words = [line.split() for line in self.log.read_text().splitlines()]
        return [int(line[1]) for line in words if line[:1] == ["guardian"] and line[1].isdigit()]

    def say(self):
        return self.log.read_text()

    def time_to_vent(self, since):
        """Return the seconds from an instant to the first vent command that ends the pressure."""

        def first():
            later = [c for c in list(self.commands) if c.stamp >= since]
            return next((c for c in later if self.is_vent(c)), None)

        wait_for(first, "a vent command")
        return (first().stamp - since) / 1e9

    def close(self):
        if self.driver is not None and self.driver.poll() is None:
            self.driver.kill()
            self.driver.wait()
        self.runner.close()


@pytest.fixture
def run(tmp_path):
    runs = []

    def make(protocol="ezloop"):
        runs.append(Run(tmp_path, protocol))
        return runs[-1]

    yield make
    for each in runs:
        each.close()


def alive(process_id):
    with contextlib.suppress(OSError):
        return "\nState:\tZ" not in open(f"/proc/{process_id}/status").read()
    return False


@pytest.mark.parametrize("protocol", ["ezloop", "ctrlp"])
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP, signal.SIGUSR1])
def test_a_driver_that_dies_stops_or_blocks_is_ended_and_the_board_vented(run, protocol, number):
    """SIGUSR1 blocks the thread of the port for an hour; the other threads go on."""
    case, took = run(protocol), []
    for _ in range(ATTEMPTS):
        case.start()
        begin = time.time_ns()
        case.driver.send_signal(number)
        took.append(case.time_to_vent(begin))
        assert case.driver.wait(60.0) == -signal.SIGKILL
        wait_for(case.vented, "vented chambers")
        last = len(case.commands)
        wait_for(lambda: not alive(case.guardians()[0]), "the end of the guardian")
        assert all(case.is_vent(command) for command in case.commands[last:])
        assert "the driver was ended" in case.say()
        if min(took) <= PROMISED:
            return
    raise AssertionError(f"vented after {took} s")


def test_a_blocked_executor_counts_as_dead(run):
    case = run()
    case.start()
    case.driver.send_signal(signal.SIGUSR2)
    assert case.driver.wait(60.0) == -signal.SIGKILL
    wait_for(case.vented, "vented chambers")
    assert "no sign of life" in case.say()


def test_after_a_kill_the_next_driver_gets_the_port(run):
    case = run()
    case.start()
    case.driver.kill()
    case.driver.wait()
    case.start()
    case.driver.terminate()
    assert case.driver.wait(60.0) == 0
    wait_for(case.vented, "vented chambers")


def test_a_normal_end_leaves_no_guardian(run):
    case = run()
    case.start()
    (guardian,) = case.guardians()
    assert alive(guardian)
    case.driver.terminate()
    assert case.driver.wait(60.0) == 0
    assert not alive(guardian)
    assert "driver was ended" not in case.say()
    wait_for(lambda: not case.port.host_present, "a port that nobody holds")


def test_signals_of_a_terminal_do_not_end_the_guardian(run):
    case = run()
    case.start()
    (guardian,) = case.guardians()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP):
        os.kill(guardian, number)
    assert os.getsid(guardian) == guardian
    begin = time.time_ns()
    case.driver.kill()
    case.time_to_vent(begin)
    wait_for(case.vented, "vented chambers")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_guardian_that_fails_is_a_fault_and_is_replaced(run, number):
    case = run()
    case.start()
    (guardian,) = case.guardians()
    begin = time.time_ns()
    os.kill(guardian, number)
    case.time_to_vent(begin)
    wait_for(lambda: "another one is started" in case.say(), "the new guardian")
    wait_for(lambda: "nothing would vent the limb if the driver died" in case.say(), "the fault")
    wait_for(lambda: not alive(guardian), "the end of the old guardian")
    wait_for(case.pressurised, "pressure again")
    begin = time.time_ns()
    case.driver.kill()
    case.time_to_vent(begin)
    wait_for(case.vented, "vented chambers")


def test_the_guardian_gets_the_port_that_comes_back(run):
    case = run()
    case.start()
    case.runner.set_faults(Faults.parse(["unplug:0.3"], 4))
    wait_for(lambda: "is back" in case.say(), "the port")
    case.runner.set_faults(Faults())
    count = len(case.commands)
    wait_for(
        lambda: any(not case.is_vent(command) for command in case.commands[count:]),
        "the driver to be armed again",
    )
    wait_for(case.pressurised, "pressure again")
    begin = time.time_ns()
    case.driver.kill()
    case.time_to_vent(begin)
    wait_for(case.vented, "vented chambers")


def test_a_driver_that_dies_without_a_port_is_told_of(run):
    case = run()
    case.start()
    case.runner.set_faults(Faults.parse(["unplug"], 4))
    wait_for(lambda: "faults serial link lost" in case.say(), "the fault")
    case.driver.kill()
    wait_for(lambda: "close the air supply" in case.say(), "the advice")
