"""A driver and an emulated board in simulated time, without ports, threads or ROS."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from pressure_driver.core import DriverCore
from pressure_driver.emulator.board import SENSOR_NOISE, EmulatedBoard, Faults
from pressure_driver.emulator.firmware import BOARDS
from pressure_driver.emulator.pneumatics import SUPPLY_PRESSURE, VENT_EXPONENT, BoardPneumatics
from pressure_driver.protocols import USUAL_LIMIT, host_protocol
from pressure_driver.safety import Mode
from pressure_driver.schedule import Setpoint, Verdict
from pressure_driver.settings import EmulatorSettings, Settings

PERIOD = 50_000_000
START = 1_700_000_000_000_000_000
VENTED = 500.0
"""[Pa] gauge that counts as vented."""
SENSORS = {"pneudrive": {"sensor_range": 100_000.0}}
"""Parameters of both ends: with the nominal range, a step of the readings is 842 Pa."""


class Simulation:
    """Ticks, line and air, one period at a time.

    Attributes worth a look: ``core``, ``board``, ``air`` (true gauge pressures), ``sent`` (bytes of
    every tick), ``received`` (time and pressures of commands, as the board saw them), ``plugged``.
    """

    def __init__(self, protocol="ezloop", seed=0, **settings):
        self.time = 0
        self.clock_error = 0
        shared = {"protocol": protocol, **SENSORS.get(protocol, {})}
        for name in {"terminal", "sensor_range"} & set(settings):
            shared[name] = settings.pop(name)
        self.settings = Settings(**shared, **settings)
        host = host_protocol(self.settings)
        self.core = DriverCore(host, self.settings, steady=lambda: self.steady)
        self._other_end = EmulatorSettings(**shared)
        self.board = EmulatedBoard(self.firmware(), BoardPneumatics(2, seed), seed)
        self._suit(self.settings.pressure_limit / USUAL_LIMIT)
        self.plugged = True
        self.sent = []
        self.received = []
        self.modes = []
        self.armings = 0
        self._receive(self.core.opening())

    def _suit(self, scale):
        """Give a stronger or weaker limb its air; supply and sensors are no smaller than usual."""
        air, board = self.board.pneumatics, self.board
        air._fill_rate *= scale
        air._vent_deadband *= scale
        air._vent_coefficient *= scale ** (1.0 - VENT_EXPONENT)
        self.board_scale = max(scale, 1.0)
        board._offset *= self.board_scale
        board.boot()
        reading, generator = board.reading, np.random.default_rng(0)

        def coarse_reading():
            told = reading()
            noise = generator.normal(0.0, SENSOR_NOISE * (self.board_scale - 1.0), 4)
            return replace(told, chamber_pressure=tuple(told.chamber_pressure + noise))

        if scale > 1.0:
            board.reading = coarse_reading
            self.have()

    def firmware(self):
        """Return a board's end that has heard nothing yet."""
        board = BOARDS[self.core.protocol.name]()
        board.configure(self._other_end)
        return board

    @property
    def steady(self):
        return self.time / 1e9

    @property
    def wall(self):
        return START + self.time + self.clock_error

    @property
    def mode(self):
        return self.core.machine.mode

    @property
    def faults(self):
        return tuple(self.core.machine.faults)

    @property
    def gauge(self):
        return self.board.pneumatics.pressure - self.board.pneumatics.atmosphere

    @property
    def vented(self):
        return bool(np.all(self.gauge < VENTED))

    def is_vent(self, data):
        """Tell whether the bytes of a tick ask the board to open every chamber."""
        board = self.firmware()
        commands = [c for c in board.decode(data) if c.kind in ("setpoint", "vent")]
        return bool(commands) and all(
            c.kind == "vent"
            or (
                np.ptp(np.reshape(c.pressure, (-1, 2)), axis=1).max() == 0.0
                and (not board.gauge or max(c.pressure) <= 0.0)
            )
            for c in commands
        )

    def _receive(self, data):
        while data and self.plugged:
            commands, answer = self.board.receive(data)
            self.received += [(self.wall, pressure) for pressure in commands]
            data = self.core.received(answer) if answer else b""

    def tick(self):
        """Advance by one period."""
        self.time += PERIOD
        data = self.core.tick(self.wall)
        self.sent.append(data)
        self.core.sent()
        self._receive(data)
        self.board.step(PERIOD / 1e9)
        report = self.board.telemetry()
        if report and self.plugged:
            self.core.received(report)
        self.modes.append(self.mode)

    def run(self, seconds):
        for _ in range(round(seconds * 1e9 / PERIOD)):
            self.tick()

    def run_until(self, condition, limit=30.0):
        """Tick until the condition holds; return the seconds it took."""
        begin = self.steady
        while not condition():
            assert self.steady - begin < limit, (self.mode, self.faults, self.gauge)
            self.tick()
        return self.steady - begin

    def have(self, *faults):
        found = Faults.parse(faults, 4)
        if found.supply == SUPPLY_PRESSURE:
            found.supply = 1e5 + (SUPPLY_PRESSURE - 1e5) * self.board_scale
        self.board.set_faults(found)

    def arm(self):
        """Wait until the driver may be armed, and arm it."""
        self.run_until(lambda: not self.core.obstacles())
        assert self.core.arm() == (True, "armed")
        self.armings += 1

    def offer(self, differential, ahead=0.2, plan_id="", index=0, revision=0, origin=None):
        """Offer a setpoint whose stamp lies on the grid, ``ahead`` seconds from now.

        Without a name, the plan is that of the last arming.
        """
        stamp = self.wall + round(ahead * 1e9 / PERIOD) * PERIOD
        plan = plan_id or f"plan of arming {self.armings}"
        item = Setpoint(stamp, tuple(differential), plan, index, revision)
        return self.core.offer(item, self.wall, origin)

    def stream(
        self, seconds, shape=lambda t: (8_000.0 * np.sin(t) ** 2, -4_000.0 * np.sin(t) ** 2)
    ):
        """Play a smooth motion, offering each setpoint 0.2 s ahead."""
        for index in range(round(seconds * 1e9 / PERIOD)):
            verdict = self.offer(shape(index * PERIOD / 1e9), index=index)
            if self.mode is not Mode.FAULT:
                assert verdict is Verdict.ACCEPTED, self.core.machine.schedule.reason
            self.tick()

    def play_until_fault(self, seconds, shape, plan_id=""):
        """Play a motion until the driver faults; return the seconds it took, or None."""
        begin = self.steady
        for index in range(round(seconds * 1e9 / PERIOD)):
            self.offer(shape(self.steady - begin), plan_id=plan_id, index=index)
            self.tick()
            if self.mode is Mode.FAULT:
                return self.steady - begin
        return None

    def modes_since(self, place):
        """Return the modes since a tick in their order."""
        return [mode for mode, _ in itertools.groupby(self.modes[place:])]

    def track(self, seconds=3.0):
        """Arm and play for a while, which leaves the limb pressurised."""
        self.arm()
        self.stream(seconds, lambda t: (min(4_000.0 * t, 9_000.0), -min(2_000.0 * t, 5_000.0)))
        assert self.mode is Mode.TRACKING


@pytest.fixture
def simulate():
    """Return `Simulation`, to be called with a protocol, a seed and settings."""
    return Simulation


@pytest.fixture
def bench(graph):
    """Return `driver_bench.Bench`, to be called with a protocol and parameters of the driver."""
    from driver_bench import Bench  # it needs ROS

    return lambda *arguments, **parameters: Bench(graph, *arguments, **parameters)
