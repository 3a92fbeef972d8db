"""Planner, driver and an emulated board: what the planner does when the driver vents or dies."""

import contextlib
import signal
import uuid
from pathlib import Path

import pytest

from der_msgs.msg import MotionCommand, PressurePlan, PressureSetpoint, PressureState
from limb_interfaces import qos, topics

pytestmark = pytest.mark.graph


class Rig:
    """The three nodes, and what passes between planner and driver."""

    def __init__(self, graph):
        self.graph, self.client = graph, graph.client
        self.setpoints, self.plans, self.states = [], [], []
        self.client.subscribe(
            PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINTS, self.setpoints.append
        )
        self.client.subscribe(PressurePlan, topics.PLAN, qos.LATCHED, self.plans.append)
        self.client.subscribe(PressureState, topics.PRESSURE_STATE, qos.STATES, self.states.append)
        node = self.client.node
        self.commands = node.create_publisher(MotionCommand, topics.COMMAND, qos.COMMANDS)
        self.link = f"/tmp/der_limb_board_test_{uuid.uuid4().hex[:8]}"
        graph.start("pressure_driver", "board_emulator", port_link=self.link)
        self.wait(Path(self.link).exists, "the board's port")
        self.driver = self.start_driver("driver")
        self.planner = graph.start("der_planner", "planner")
        self.client.wait_ready(["board_emulator", "pressure_driver", "planner"])
        self.wait(self.commands.get_subscription_count, "the planner to listen")
        self.wait(lambda: self.said("driver") == "DISARMED", "the planner to hear the driver")

    def start_driver(self, name):
        return self.graph.start("pressure_driver", "pressure_driver", name, port=self.link)

    def wait(self, condition, what):
        return self.client.wait_for(condition, 60.0, what)

    def said(self, key):
        return self.client.diagnostic_values("planner").get(key, "")

    def command(self, plan_id):
        self.commands.publish(
            MotionCommand(
                motion="same_direction", amplitude=0.6, period=20.0, cycles=1, plan_id=plan_id
            )
        )

    def received(self, plan_id):
        return [message for message in self.setpoints if message.plan_id == plan_id]

    def arm(self):
        def armed():
            with contextlib.suppress(Exception):
                return self.client.call("pressure_driver/arm", 20.0)

        self.wait(armed, "the driver to arm")

    def play(self, plan_id):
        """Command a plan and wait until the driver tracks it."""
        self.command(plan_id)
        self.wait(lambda: len(self.received(plan_id)) > 20, "setpoints")
        self.wait(lambda: self.states[-1].mode == PressureState.TRACKING, "tracking")

    def nothing_more_comes(self):
        """What was on its way has arrived; from now on nothing is sent."""
        self.client.spin(0.5)
        count = len(self.setpoints)
        self.client.spin(1.0)
        return len(self.setpoints) == count


@pytest.fixture
def rig(graph):
    return Rig(graph)


def test_a_driver_that_vents_hangs_or_dies_is_sent_nothing_more(rig):
    rig.command("early")
    rig.wait(lambda: rig.said("state") == "refused", "the refusal")
    assert "the driver is DISARMED: arm the driver" in rig.said("reason")
    assert not rig.setpoints
    rig.arm()
    rig.play("old")
    rig.client.call("pressure_driver/vent")
    rig.wait(lambda: rig.said("state") == "vented", "the planner to see it")
    assert "plan old vented after" in rig.planner.log.read_text()
    assert rig.nothing_more_comes()
    rig.arm()
    rig.wait(lambda: rig.said("driver") == "ARMED", "the planner to hear of it")
    begin = len(rig.states)
    assert rig.nothing_more_comes()
    assert max(abs(u) for s in rig.states[begin:] for u in s.commanded_differential) == 0.0

    rig.command("old")  # the driver has ended this plan: it needs another name
    rig.wait(lambda: "give the command another plan_id" in rig.said("reason"), "a refusal")
    rig.client.call("planner/start")
    again = rig.wait(lambda: rig.received("old-2"), "the plan under a new name")
    assert again[0].index == 0
    assert rig.plans[-1].plan_id == "old-2"
    rig.wait(lambda: rig.states[-1].mode == PressureState.TRACKING, "tracking")

    rig.driver.signal(signal.SIGSTOP)
    rig.wait(lambda: rig.said("state") == "lost", "the planner to miss the driver")
    assert "has said nothing for" in rig.said("reason")
    assert rig.nothing_more_comes()
    rig.driver.signal(signal.SIGKILL)
    rig.wait(lambda: not rig.driver.alive, "its end")
    rig.command("late")
    rig.wait(lambda: rig.said("plan_id") == "late" and rig.said("state") == "refused", "refusal")
    assert not rig.received("late")
    rig.driver = rig.start_driver("driver_again")
    rig.wait(lambda: rig.said("driver") == "DISARMED", "the new driver")
    rig.arm()
    rig.wait(lambda: rig.said("driver") == "ARMED", "the planner to hear of it")
    rig.play("after")
