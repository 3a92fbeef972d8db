"""The port's thread on a real pseudo-terminal, with an emulated board at the other end."""

import itertools
import os
import re
import select
import termios
import threading
import time

import pytest

from pressure_driver import link, ports
from pressure_driver.core import DriverCore
from pressure_driver.emulator.board import EmulatedBoard, Faults
from pressure_driver.emulator.pneumatics import BoardPneumatics
from pressure_driver.emulator.port import EmulatedPort
from pressure_driver.emulator.runner import BoardRunner
from pressure_driver.link import SerialLink
from pressure_driver.ports import PortError, open_port
from pressure_driver.protocols import board_protocol, host_protocol
from pressure_driver.realtime import prefer_thread
from pressure_driver.safety import Mode
from pressure_driver.schedule import Setpoint, Verdict

PERIOD = 50_000_000


def wait_for(condition, limit=60.0):
    deadline = time.monotonic() + limit
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.005)


class Rig:
    """A driver without ROS and a board, connected by a pseudo-terminal."""

    def __init__(self, folder, protocol="ezloop"):
        self.commands = []
        self.port = EmulatedPort(str(folder / "board"), 115_200)
        self.board = EmulatedBoard(board_protocol(protocol), BoardPneumatics(2, 1), 1)
        self.runner = BoardRunner(self.board, self.port, on_command=self.commands.append)
        self.runner.start()
        settings = CoreSettings(rest_time=0.15)
        self.core = DriverCore(host_protocol(protocol), settings)
        self.link = SerialLink(str(self.port.link), 115_200, TickGrid(PERIOD), self.core)
        self.link.start()

    def arm(self):
        wait_for(lambda: self.core.arm()[0])

    def play(self, count):
        """Offer setpoints 0.2 s ahead in real time; return stamp -> difference."""
        start = (time.time_ns() // PERIOD + 6) * PERIOD
        wanted = {}
        for index in range(count):
            stamp = start + index * PERIOD
            while time.time_ns() < stamp - 200_000_000:
                time.sleep(0.002)
            value = 300.0 * (index + 1)
            if self.core.offer(Setpoint(stamp, (value, 0.0), "p", index), time.time_ns()) is (
                Verdict.ACCEPTED
            ):
                wanted[stamp] = value
        return wanted

    def have(self, *texts):
        self.runner.set_faults(Faults.parse(texts, 4))

    @property
    def mode(self):
        return self.core.mode

    def pressurise(self):
        """Arm and play until a chamber is full; a machine that stalls may need several turns."""
        self.arm()
        deadline = time.monotonic() + 60.0
        while not self.pressurised():
            assert time.monotonic() < deadline, "no pressure in any chamber"
            self.play(8)

    def pressurised(self):
        return max(self.board.pneumatics.pressure) > self.board.pneumatics.atmosphere + 1000.0

    def close(self):
        self.link.close()
        self.runner.close()


@pytest.fixture
def rig(tmp_path):
    running = Rig(tmp_path)
    yield running
    running.close()


def differences(commands):
    return [round(c.pressure[0] - c.pressure[1], 1) for c in commands]


def test_setpoints_arrive_in_order_not_before_their_stamps(rig):
    rig.arm()
    wanted = rig.play(20)
    wait_for(lambda: rig.core.waiting == 0 and rig.mode is not Mode.TRACKING)
    first_seen = {}
    for command, value in zip(rig.commands, differences(rig.commands), strict=True):
        first_seen.setdefault(value, command.stamp)
    order = [first_seen[v] for v in wanted.values() if v in first_seen]
    assert order == sorted(order)
    counters = rig.core.counters
    assert len(order) + counters.superseded == len(wanted) == counters.accepted
    for stamp, value in wanted.items():
        if value in first_seen:
            assert first_seen[value] >= stamp


def test_closing_puts_vent_on_the_wire(rig):
    rig.pressurise()
    assert rig.link.close()
    assert rig.link.vented_at_end
    wait_for(lambda: differences(rig.commands)[-3:] == [0.0] * 3)
    wait_for(lambda: not rig.pressurised())
    wait_for(lambda: not rig.port.host_present)


def test_an_urgent_vent_does_not_wait_for_the_tick(rig):
    rig.arm()
    rig.play(10)
    rig.core.vent()
    rig.link.urge()
    wait_for(lambda: differences(rig.commands)[-1] == 0.0)
    assert rig.mode in (Mode.VENTING, Mode.DISARMED)


def test_an_unplug_faults_and_the_return_vents(rig):
    rig.arm()
    rig.play(5)
    rig.have("unplug:0.5")
    wait_for(lambda: rig.mode is Mode.FAULT)
    assert "serial link lost" in rig.core.faults[0]
    wait_for(lambda: rig.link.reconnects == 1)
    count = len(rig.commands)
    wait_for(lambda: len(rig.commands) > count + 5)
    assert set(differences(rig.commands[count:])) == {0.0}
    assert rig.mode is Mode.FAULT
    rig.have()
    rig.arm()


def test_an_exception_in_the_thread_vents_and_is_reported(rig):
    rig.pressurise()
    rig.core.sent = lambda _: 1 / 0
    wait_for(lambda: rig.link.error is not None)
    assert isinstance(rig.link.error, ZeroDivisionError)
    wait_for(lambda: differences(rig.commands)[-3:] == [0.0] * 3)


def test_a_board_that_takes_no_bytes_does_not_stop_the_ticks(tmp_path):
    """The other end is open but never read: the thread must not hang in a write."""
    master, slave = os.openpty()
    try:
        core = DriverCore(host_protocol("ezloop"), Settings())
        port = SerialLink(os.ttyname(slave), 115_200, TickGrid(1_000_000), core)
        port.start()
        wait_for(lambda: port.bytes_sent > 3000)
        wait_for(lambda: "takes no bytes" in core._machine.link_fault)
        assert port.close()
    finally:
        os.close(master)
        os.close(slave)


def test_a_missing_port_is_named_with_the_remedy(tmp_path):
    missing = str(tmp_path / "ttyNOWHERE")
    with pytest.raises(PortError, match=f"no serial device {re.escape(missing)}.*ports that exist"):
        open_port(missing, 115_200)


def test_a_port_in_use_is_named_with_the_remedy(rig):
    with pytest.raises(PortError, match=r"in use by another program.*fuser"):
        open_port(str(rig.port.link), 115_200)


def test_a_file_is_no_port(tmp_path):
    path = tmp_path / "file"
    path.write_text("text")
    with pytest.raises(PortError, match="is no serial port"):
        open_port(str(path), 115_200)


def test_the_port_is_free_again_after_closing(rig):
    assert rig.link.close()
    open_port(str(rig.port.link), 115_200).close()


def test_only_the_thread_touches_the_port(rig, monkeypatch):
    users, port = set(), rig.link._device.fileno()

    def watch(original):
        def watched(descriptor, argument):
            if descriptor == port:
                users.add(threading.current_thread().name)
            return original(descriptor, argument)

        return watched

    monkeypatch.setattr(os, "write", watch(os.write))
    monkeypatch.setattr(os, "read", watch(os.read))
    rig.arm()
    rig.play(5)
    rig.link.urge()
    rig.link.close()
    assert users == {"serial link"}


def test_a_pty_of_the_system_is_a_port():
    """Without an emulator: raw bytes at the other end of a pseudo-terminal."""
    master, slave = os.openpty()
    try:
        device = open_port(os.ttyname(slave), 115_200)
        device.write(b"<1013.00>\n")
        assert select.select([master], [], [], 60.0)[0]
        assert os.read(master, 100) == b"<1013.00>\n"
        device.close()
    finally:
        os.close(master)
        os.close(slave)


def test_a_port_is_kept_by_its_stable_name(tmp_path, monkeypatch):
    (tmp_path / "by-id").mkdir()
    device, other = tmp_path / "ttyACM0", tmp_path / "ttyACM1"
    device.touch()
    other.touch()
    stable = tmp_path / "by-id" / "usb-Arduino_Mega-if00"
    stable.symlink_to(device)
    monkeypatch.setattr(ports, "STABLE_NAMES", tmp_path / "by-id")
    assert ports.stable_name(str(device)) == str(stable)
    assert ports.stable_name(str(stable)) == str(stable)
    assert ports.stable_name(str(other)) == str(other)
    assert str(stable) in ports.available_ports()


def test_a_port_that_does_not_open_is_tried_with_growing_delays(rig, monkeypatch):
    looks = []

    def fails(*_):
        looks.append(time.monotonic())
        raise PortError("not there")

    monkeypatch.setattr(link, "FIRST_RETRY", 0.02)
    monkeypatch.setattr(link, "LAST_RETRY", 0.2)
    monkeypatch.setattr(link, "open_port", fails)
    rig.have("unplug:0.2")
    wait_for(lambda: len(looks) >= 10)
    gaps = [b - a for a, b in itertools.pairwise(looks)]
    # A gap is the delay or longer, since the thread also waits for its ticks.
    for count, gap in enumerate(gaps):
        assert gap >= min(0.02 * 1.6 ** (count + 1), 0.2) - 0.005, gaps
    assert rig.link.reconnects == 0
    monkeypatch.undo()
    rig.have()
    wait_for(lambda: rig.link.reconnects == 1)


def test_a_replugged_board_is_vented_promptly_however_long_it_was_away(rig):
    """The name of the port is watched: no delay grows while it is not there."""
    took: dict[float, float] = {}

    def unplug_for(away):
        rig.arm()
        rig.play(3)
        rig.have("unplug")
        wait_for(lambda: rig.mode is Mode.FAULT)
        time.sleep(away)
        count = len(rig.commands)
        back = time.time_ns()
        rig.have()
        wait_for(lambda seen=count: len(rig.commands) > seen)
        assert differences(rig.commands[count:])[0] == 0.0
        took[away] = (rig.commands[count].stamp - back) / 1e9

    for _ in range(5):  # a busy machine may keep the thread waiting, not each time
        for away in (0.3, 2.5, 0.1):
            unplug_for(away)
        if min(took.values()) < 0.25 and took[2.5] < 1.0:
            return
    raise AssertionError(took)


def test_a_port_that_takes_no_bytes_is_a_fault_and_old_setpoints_are_not_sent_afterwards(rig):
    """Output is held back by the terminal itself, as by a board whose USB does not fetch bytes."""
    rig.pressurise()
    terminal = os.open(os.path.realpath(rig.port.link), os.O_RDWR | os.O_NOCTTY)
    try:
        termios.tcflow(terminal, termios.TCOOFF)
        count = len(rig.commands)
        begin = time.monotonic()
        rig.play(4)
        wait_for(lambda: rig.mode is Mode.FAULT)
        assert time.monotonic() - begin < 20.0
        assert "does not read" in rig.core.faults[0]
        termios.tcflow(terminal, termios.TCOON)
    finally:
        os.close(terminal)
    wait_for(lambda: len(rig.commands) > count + 5)
    # What was on its way when the terminal was stopped may still come; nothing from later.
    assert set(differences(rig.commands[count + 1 :])) == {0.0}
    wait_for(lambda: not rig.pressurised())


def test_a_vent_overtakes_what_the_board_has_not_read_yet(rig):
    """The board stops reading, but goes on reporting, while setpoints are written for it."""
    rig.pressurise()
    reading = threading.Event()
    real, rig.port.read = rig.port.read, lambda *arguments: reading.is_set() and real(*arguments)
    # Far more than the kernel hands on at once, so that most of it still waits to be delivered.
    stale = b"<1050.00,1010.00,1010.00,1010.00>\n" * 300
    rig.link._write(stale)
    before = len(rig.commands)
    rig.core.vent()
    sent = rig.link.bytes_sent
    rig.link.urge()
    wait_for(lambda: rig.core.mode in (Mode.VENTING, Mode.FAULT))
    wait_for(lambda: rig.link.bytes_sent > sent)
    reading.set()
    wait_for(lambda: len(rig.commands) > before and differences(rig.commands)[-1] == 0.0)
    assert sum(value != 0.0 for value in differences(rig.commands[before:])) < 150
    wait_for(lambda: not rig.pressurised())


def test_without_the_board_the_end_is_no_vent(rig):
    rig.pressurise()
    rig.have("unplug")
    wait_for(lambda: rig.mode is Mode.FAULT)
    assert rig.link.close()
    assert not rig.link.vented_at_end


def test_telemetry_that_comes_too_late_is_no_telemetry(rig):
    rig.arm()
    rig.have("delay:60")
    wait_for(lambda: rig.mode is Mode.FAULT)
    assert "no telemetry" in rig.core.faults[0]


def test_without_the_right_to_real_time_the_thread_runs_as_well(rig, monkeypatch):
    def refuse(*_):
        raise PermissionError("not allowed")

    monkeypatch.setattr("os.sched_setscheduler", refuse)
    assert not prefer_thread(10)
    assert not prefer_thread(0)
