"""A driver and an emulated board as running nodes, for the tests of both."""

import contextlib
import os
import subprocess
import sys
import time
import uuid

import numpy as np

from benchmarks.driver import play
from der_msgs.msg import ChamberPressures, PressureSetpoint, PressureState
from limb_interfaces import qos, topics

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

    def __init__(self, graph, protocol="ezloop", bounds=QUICK, **parameters):
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
        self.parameters = {"port": self.link, "protocol": protocol, **bounds, **parameters}
        self.start_driver()

    def start_driver(self):
        self.driver = self.graph.start("pressure_driver", "pressure_driver", **self.parameters)
        self.client.diagnostics.pop("pressure_driver", None)
        self.client.watch([self.board, self.driver])
        self.client.wait_ready(["pressure_driver"])
        self.wait(self.publisher.get_subscription_count, "the driver's subscription")
        self.wait(lambda: self.air, "the air")

    @contextlib.contextmanager
    def other_driver(self, code):
        """Run a driver from Python code in the place of the installed one."""
        self.driver.stop()
        self.client.watch([self.board])
        words = [
            word for name, value in self.parameters.items() for word in ("-p", f"{name}:={value}")
        ]
        process = subprocess.Popen(
            [sys.executable, "-c", code, "--ros-args", *words],
            env={**os.environ, "ROS_DOMAIN_ID": str(self.graph.domain_id)},
            stderr=subprocess.PIPE,
        )
        try:
            self.states.clear()
            self.wait(lambda: self.states, "the driver")
            self.wait(self.publisher.get_subscription_count, "the driver's subscription")
            yield process
        finally:
            process.kill()
            process.wait()

    def wait(self, condition, what, limit=60.0):
        return self.client.wait_for(condition, limit, what)

    @property
    def mode(self):
        return self.states[-1].mode if self.states else -1

    def wait_mode(self, mode, limit=60.0):
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
        self.wait(try_to_arm, "the driver to arm")

    def play(self, count, shape):
        """Publish setpoints 0.2 s ahead in real time; return stamp -> differential pressures."""
        # A plan belongs to one arming.
        return play(self.client, self.publisher, count, shape, uuid.uuid4().hex)

    def pressurise(self):
        """Arm and play until a chamber is full; a machine that stalls may need several turns."""
        self.arm()
        deadline = time.monotonic() + 90.0
        while self.gauge().max() < 2000.0:
            assert time.monotonic() < deadline, "no pressure in any chamber"
            self.play(8, lambda k: (min(900.0 * (k + 1), 3500.0), -min(500.0 * (k + 1), 2000.0)))


def difference(command):
    pressure = np.array(command.pressure)
    return pressure[0::2] - pressure[1::2]
