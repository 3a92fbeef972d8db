"""The process of the port on a pseudo-terminal: what it plays, and who vents when one ends."""

import itertools
import json
import os
import re
import select
import signal
import socket
import subprocess
import sys
import termios
import time
from types import SimpleNamespace

import pytest
from domain import free_port
from serial import SerialException
from waiting import wait_for

from pressure_driver import entry, lines, port_process
from pressure_driver.board import BoardProcess
from pressure_driver.emulator.board import EmulatedBoard, Faults
from pressure_driver.emulator.firmware import BOARDS
from pressure_driver.emulator.line import emulated_line
from pressure_driver.emulator.pneumatics import BoardPneumatics
from pressure_driver.emulator.runner import BoardRunner
from pressure_driver.lines import Channel, open_line, tcp_address
from pressure_driver.port_process import PortError, PortProcess, explain, stable_name
from pressure_driver.protocols import NAMES
from pressure_driver.safety import Mode
from pressure_driver.settings import EmulatorSettings, Settings

pytestmark = pytest.mark.slow

PERIOD = 50_000_000
COUNT = itertools.count(1)
"""Of messages, as the middleware counts them."""
SENSOR_RANGE = 100_000.0
"""[Pa] of PneuDrive boards: with the nominal range, a step of the readings is 842 Pa."""


class Rig:
    """An emulated board in this process, and a driver on its port; its times are short."""

    def __init__(self, folder, protocol):
        self.commands = []
        link = (
            f"tcp://127.0.0.1:{free_port()}"
            if protocol == "festo"
            else str(folder / f"board_{protocol}")
        )
        self.port = emulated_line(link)
        air = BoardPneumatics(2, 1)
        # Valves ten times as wide, so that nobody waits for the air.
        air._fill_rate, air._vent_coefficient = 10 * air._fill_rate, 10 * air._vent_coefficient
        firmware = BOARDS[protocol]()
        firmware.configure(EmulatorSettings(sensor_range=SENSOR_RANGE))
        self.board = EmulatedBoard(firmware, air, 1)
        self.runner = BoardRunner(self.board, self.port, on_command=self.note)
        self.runner.start()
        self.settings = Settings(
            port=self.port.link,
            protocol=protocol,
            atmosphere=self.board.atmosphere,
            sensor_range=SENSOR_RANGE,
            slew_limit=1e6,
            vent_rate=2e4,
            hold_time=0.2,
        )
        self.said, self.state, self.armings = [], {}, 0

    def note(self, _, pressure):
        self.commands.append(pressure)

    def start(self):
        """Have the node's end of the driver in this process, and the port's in one of its own."""
        self.driver = PortProcess(self.settings, self.hear)
        self.driver.start()
        return self

    def hear(self):
        while self.driver.log:
            self.said.append(self.driver.log.popleft()[0])
        while self.driver.states:
            self.state = self.driver.states.popleft()

    def send(self, *message):
        self.driver.send(*message)

    @property
    def mode(self):
        return self.state.get("mode")

    def ask(self, word):
        self.send("alive")
        return self.driver.ask(word)[0]

    def offer(self, differential, stamp=0, index=0):
        plan = f"plan {self.armings}"
        self.send("setpoint", stamp, list(differential), plan, index, 0, "topic", next(COUNT), True)

    def pressurise(self):
        """Arm and play until a chamber is full."""
        wait_for(lambda: self.ask("arm"), "the driver to be armed")
        self.armings += 1
        wait_for(lambda: self.offer((3000.0, -2000.0)) or self.pressurised(), "pressure")

    def pressurised(self):
        air = self.board.pneumatics
        return max(air.pressure) > air.atmosphere + 1000.0

    def vents(self, since=0):
        """Tell for each command since one of them whether it asks for equal pressures."""
        pairs = list(self.commands)[since:]
        return [max(abs(p[0] - p[1]), abs(p[2] - p[3])) < 1.0 for p in pairs]

    def wait_vented(self):
        wait_for(lambda: not self.pressurised(), "vented chambers")
        assert self.vents()[-1]

    def have(self, *texts):
        self.runner.set_faults(Faults.parse(texts, 4))

    def close(self):
        self.driver.close()
        self.runner.close()


class SilentNode(Rig):
    """The node's end without the thread that watches: it can be silent, and go."""

    def start(self):
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        words = ["-m", "pressure_driver.board", str(far.fileno()), json.dumps(vars(self.settings))]
        self.process = subprocess.Popen(
            [sys.executable, *words],
            pass_fds=(far.fileno(),),
            stderr=subprocess.PIPE,
        )
        far.close()
        self.channel = Channel(near)
        near.settimeout(30.0)
        self.modes = []
        return self

    def send(self, *message):
        self.channel.send(*message)

    def ask(self, word):
        self.send(word)
        while (content := self.listen())[0] != "answer":
            pass
        return content[1]

    def fileno(self):
        return self.channel.fileno()

    def listen(self):
        """Return the next message, and note the mode."""
        content, _ = self.channel.receive()
        if content[0] == "state":
            self.state = content[1]
            if self.modes[-1:] != [self.mode]:
                self.modes.append(self.mode)
        return content

    def close(self):
        self.channel.socket.close()
        self.process.wait(30.0)
        self.process.stderr.close()
        self.runner.close()


@pytest.fixture
def make_rigs(tmp_path):
    """Return a function that starts one rig for each protocol."""
    made = []

    def make(*protocols, kind=Rig):
        made.extend(kind(tmp_path, protocol) for protocol in protocols)
        return [rig.start() for rig in made]

    yield make
    for rig in made:
        rig.close()


@pytest.fixture
def rig(make_rigs):
    return make_rigs("ezloop")[0]


# -------------------------------------------------------------------------------- it plays


def test_vent_is_at_once_and_the_end_leaves_the_port(rig):
    rig.pressurise()
    assert rig.ask("vent")
    count = len(rig.commands)
    rig.offer((3000.0, 0.0))
    rig.wait_vented()
    assert all(rig.vents(count + 1))

    rig.pressurise()
    assert rig.driver.close() == ""
    wait_for(lambda: rig.vents()[-3:] == [True] * 3, "the last commands")
    rig.wait_vented()
    wait_for(lambda: not rig.port.host_present, "the port to be left")
    open_line(rig.port.link, 115_200).close(drop=True)


def test_by_hand_it_takes_lines_from_a_terminal(rig):
    rig.driver.close()
    command = [sys.executable, "-c", "from pressure_driver import entry; entry.board()"]
    command += [f"--{name.replace('_', '-')}={value}" for name, value in vars(rig.settings).items()]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    )

    def armed():
        process.stdin.write("arm\n")
        return process.stdout.readline() == "armed\n"

    wait_for(armed, "an answer")
    for line in ("500 0\n", "3000 -2000\n"):
        process.stdin.write(line)
    wait_for(rig.pressurised, "pressure")
    process.stdin.write("ventt\nVent\n")
    rig.wait_vented()
    process.stdin.close()
    assert process.wait(30.0) == 0
    assert "['ventt'] is no order: write arm, vent" in process.stdout.read()


def test_a_switch_that_is_neither_true_nor_false_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["board", "--supply-required", "yes"])
    with pytest.raises(SystemExit):
        entry.board()
    assert "--supply-required: invalid true_or_false value: 'yes'" in capsys.readouterr().err


# ------------------------------------------------------------- one of the two processes ends


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM])
def test_the_node_vents_for_a_process_of_the_port_that_dies_or_hangs(make_rigs, number):
    rigs = make_rigs(*(NAMES if number == signal.SIGKILL else ("ezloop",)))
    for rig in rigs:
        rig.pressurise()
    for rig in rigs:
        os.kill(rig.driver.process_id, number)
    for rig in rigs:
        wait_for(lambda rig=rig: rig.driver.error, "the node to notice")
        told = "(has ended|no sign of life).* was sent|ended by somebody else: .* vented"
        assert re.search(told, rig.driver.error)
        rig.wait_vented()
        assert not rig.driver.ask("arm")[0]
        wait_for(lambda rig=rig: not rig.port.host_present, "a port that nobody holds")


def test_a_node_that_hangs_has_the_limb_let_down_and_may_go_on_and_one_that_ends_is_vented_for(
    make_rigs,
):
    """Though setpoints for seconds have arrived: nobody could stop them."""
    rigs = make_rigs(*NAMES, kind=SilentNode)
    for rig in rigs:
        wait_for(lambda rig=rig: rig.ask("arm"), "the driver to be armed")
    start = (time.time_ns() // PERIOD + 10) * PERIOD
    for rig, index in itertools.product(rigs, range(180)):
        rig.offer((3000.0, -2000.0), start + index * PERIOD, index)
    waiting = set(rigs)
    while waiting:
        for rig in select.select(waiting, [], [], 30.0)[0]:
            rig.listen()
            if Mode.VENTING in rig.modes and rig.mode == Mode.ARMED:
                waiting.remove(rig)
    for rig in rigs:
        assert rig.state["setpoints_executed"] < 180, "played to the end"
        assert rig.modes[-4:] == [Mode.TRACKING, Mode.HOLDING, Mode.VENTING, Mode.ARMED]
        wait_for(lambda rig=rig: rig.offer((3000.0, -2000.0)) or rig.pressurised(), "pressure")
        rig.channel.socket.close()
    for rig in rigs:
        assert rig.process.wait(30.0) == 1
        told = rig.process.stderr.read()
        assert b"the driver's node has ended: the vent command was sent" in told
        rig.wait_vented()


# ------------------------------------------------------------------------------- the port


def test_an_unplug_faults_and_the_return_vents_and_a_death_without_the_board_is_told_of(rig):
    rig.pressurise()
    rig.have("unplug:0.5")
    wait_for(lambda: rig.mode == Mode.FAULT, "the fault")
    assert "serial link lost" in rig.state["faults"][0]
    wait_for(lambda: any("is back" in text for text in rig.said), "the port")
    count = len(rig.commands)
    wait_for(lambda: len(rig.commands) > count + 5, "commands")
    assert all(rig.vents(count))
    assert rig.mode == Mode.FAULT
    rig.have()
    rig.pressurise()
    rig.have("unplug")
    wait_for(lambda: rig.mode == Mode.FAULT, "the fault")
    os.kill(rig.driver.process_id, signal.SIGKILL)
    wait_for(lambda: rig.driver.error, "the node to notice")
    assert "close the air supply" in rig.driver.error


def test_a_port_that_takes_no_bytes_is_a_fault_and_old_setpoints_are_not_sent_afterwards(rig):
    """Output is held back by the terminal itself, as by a board whose USB does not fetch bytes."""
    rig.pressurise()
    terminal = os.open(os.path.realpath(rig.port.link), os.O_RDWR | os.O_NOCTTY)
    try:
        termios.tcflow(terminal, termios.TCOOFF)
        count = len(rig.commands)
        wait_for(lambda: rig.offer((3000.0, -2000.0)) or rig.mode == Mode.FAULT, "the fault")
        assert "does not read" in rig.state["faults"][0]
        termios.tcflow(terminal, termios.TCOON)
    finally:
        os.close(terminal)
    wait_for(lambda: len(rig.commands) > count + 5, "commands")
    # What was on its way when the terminal was stopped may still come; nothing from later.
    assert all(rig.vents(count + 1))
    rig.wait_vented()


def test_a_board_that_takes_no_bytes_does_not_stop_the_ticks():
    """The other end is open but never read: the process must not hang in a write."""
    master, slave = os.openpty()
    settings = Settings(port=os.ttyname(slave), rate=100.0, segment_count=16)
    driver = PortProcess(settings, lambda: None)
    driver.start()
    try:
        wait_for(lambda: "takes no bytes" in str(list(driver.log)), "the fault")
        driver.close()
        assert not driver.error
    finally:
        os.close(master)
        os.close(slave)


def test_an_exception_in_the_process_vents(rig):
    rig.pressurise()
    rig.send("setpoint", "nonsense")
    wait_for(lambda: rig.driver.error, "the end of the process")
    rig.wait_vented()


@pytest.mark.parametrize(
    ("fault", "told"), [("unplug", "cannot be reached"), ("deaf", r"chambers .* keep \d+ Pa")]
)
def test_an_end_that_may_not_have_vented_says_so(rig, fault, told):
    """A board that hears nothing, or reads nothing from a pseudo-terminal, keeps its pressures."""
    rig.pressurise()
    wait_for(lambda: max(rig.state["measured_differential"]) > 1000.0, "the reading")
    rig.have(fault)
    wait_for(lambda: rig.board.faults.deaf or not rig.port.host_present, "the fault")
    assert re.search(f"{told}.*close the air supply", rig.driver.close())


def test_a_connection_that_ends_is_a_fault_and_the_next_one_vents(make_rigs):
    (rig,) = make_rigs("festo")
    rig.pressurise()
    with pytest.raises(OSError, match="in use") as raised:
        open_line(rig.settings.port, 0)
    assert "end it" in explain(rig.settings.port, raised.value)
    rig.have("unplug:0.5")
    wait_for(lambda: rig.mode == Mode.FAULT, "the fault")
    assert "link lost" in rig.state["faults"][0]
    wait_for(lambda: any("is back" in text for text in rig.said), "the connection")
    rig.have()
    rig.wait_vented()
    assert rig.mode == Mode.FAULT
    rig.pressurise()


@pytest.mark.parametrize("reads", [True, False])
def test_a_far_board_acknowledges_late_what_it_reads(reads, monkeypatch):
    monkeypatch.setattr(lines, "bytes_waiting", lambda _: 102)
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with near, far:
        process = BoardProcess(Settings(real_time_priority=0), Channel(near), 1.0)
        lost = []
        process._line, process._lose = SimpleNamespace(fileno=lambda: -1), lost.append
        for tick in range(40):
            process.core.clock = lambda tick=tick: tick / 20
            process._bytes_sent += 34 * reads
            process._watch_queue()
        assert bool(lost) != reads


def test_the_last_vent_command_may_be_acknowledged_late(monkeypatch):
    waiting = iter([102, 34, 0])
    monkeypatch.setattr(lines, "bytes_waiting", lambda _: next(waiting))
    near, far = socket.socketpair()
    with near, far:
        assert lines.vent_line(near.fileno(), b"vent", 0.01) == ""


# ---------------------------------------------------------------------------- names and rights


def test_ports_that_do_not_open_are_named_with_the_remedy(rig, tmp_path):
    missing, file = str(tmp_path / "ttyNOWHERE"), tmp_path / "file"
    file.write_text("text")
    for port, told in (
        (missing, f"no serial device {re.escape(missing)}.*ports that exist"),
        (rig.port.link, r"in use by another program.*fuser"),
        (str(file), "is no serial port"),
    ):
        with pytest.raises(SerialException) as raised:
            open_line(port, 115_200)
        assert re.search(told, explain(port, raised.value))
    with pytest.raises(PortError, match="no serial device"):
        PortProcess(Settings(port=missing), lambda: None).start()


def test_a_port_is_kept_by_its_stable_name(tmp_path, monkeypatch):
    (tmp_path / "by-id").mkdir()
    device, other = tmp_path / "ttyACM0", tmp_path / "ttyACM1"
    device.touch()
    other.touch()
    stable = tmp_path / "by-id" / "usb-Arduino_Mega-if00"
    stable.symlink_to(device)
    monkeypatch.setattr(port_process, "STABLE_NAMES", tmp_path / "by-id")
    assert port_process.stable_name(str(device)) == str(stable)
    assert port_process.stable_name(str(stable)) == str(stable)
    assert port_process.stable_name(str(other)) == str(other)
    assert str(stable) in port_process.available_ports()


def test_a_board_that_nobody_reaches_is_named_with_the_remedy():
    address = f"tcp://127.0.0.1:{free_port()}"
    with pytest.raises(PortError, match=f"no board answers at {re.escape(address)}"):
        PortProcess(Settings(port=address, protocol="festo"), lambda: None).start()
    for text in ("tcp://host", "tcp://a:b:1", "tcp://host:70000"):
        with pytest.raises(OSError, match="write tcp://host:port"):
            tcp_address(text)
    assert stable_name("tcp://localhost:502") == "tcp://127.0.0.1:502", "asked once, not again"


def test_the_process_of_the_port_loads_neither_ros_nor_the_part_of_the_node():
    listed = [sys.executable, "-c", "import sys, pressure_driver.board; print(*sys.modules)"]
    loaded = subprocess.run(listed, capture_output=True, text=True, check=True).stdout.split()
    assert "pressure_driver.core" in loaded
    node = {"pressure_driver.settings", "pressure_driver.port_process", "pressure_driver.entry"}
    assert not {"rclpy", "numpy", "numba", *node} & set(loaded)
