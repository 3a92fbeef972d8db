"""Planner, driver and an emulated board: what the planner does when the driver vents or dies."""

import signal

import pytest
from driver_bench import Bench

from der_msgs.msg import MotionCommand, PressurePlan, PressureSetpoint, PressureState
from limb_interfaces import qos, topics

pytestmark = pytest.mark.graph


class Rig(Bench):
    """The three nodes, and what passes between planner and driver."""

    def __init__(self, graph):
        self.planner = graph.start(
            "der_planner", "planner"
        )  # takes longest: others start meanwhile
        super().__init__(graph, bounds={})
        self.setpoints, self.plans = [], []
        self.client.subscribe(
            PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINTS, self.setpoints.append
        )
        self.client.subscribe(PressurePlan, topics.PLAN, qos.LATCHED, self.plans.append)
        node = self.client.node
        self.motions = node.create_publisher(MotionCommand, topics.COMMAND, qos.COMMANDS)
        self.client.wait_ready(["planner"])
        self.wait(self.motions.get_subscription_count, "the planner to listen")
        self.wait(lambda: self.said("driver") == "DISARMED", "the planner to hear the driver")

    def said(self, key):
        return self.client.diagnostic_values("planner").get(key, "")

    def command(self, plan_id):
        self.motions.publish(
            MotionCommand(
                motion="same_direction", amplitude=0.6, period=20.0, cycles=1, plan_id=plan_id
            )
        )

    def received(self, plan_id):
        return [message for message in self.setpoints if message.plan_id == plan_id]

    def play_plan(self, plan_id):
        """Command a plan and wait until the driver tracks it."""
        self.command(plan_id)
        self.wait(lambda: len(self.received(plan_id)) > 20, "setpoints")
        self.wait_mode(PressureState.TRACKING)

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
    rig.play_plan("old")
    rig.client.call("pressure_driver/vent")
    rig.wait(lambda: rig.said("state") == "vented", "the planner to see it")
    assert "plan old vented after" in rig.planner.log.read_text()
    assert rig.nothing_more_comes()
    rig.arm()
    rig.wait(lambda: rig.said("state") == "idle", "the planner to hear of it")
    begin = len(rig.states)
    assert rig.nothing_more_comes()
    assert max(abs(u) for s in rig.states[begin:] for u in s.commanded_differential) == 0.0

    rig.command("old")  # the driver has ended this plan: it needs another name
    rig.wait(lambda: "give the command another plan_id" in rig.said("reason"), "a refusal")
    rig.client.call("planner/start")
    again = rig.wait(lambda: rig.received("old-2"), "the plan under a new name")
    assert again[0].index == 0
    assert rig.plans[-1].plan_id == "old-2"
    rig.wait_mode(PressureState.TRACKING)

    rig.driver.signal(signal.SIGSTOP)
    rig.wait(lambda: rig.said("state") == "lost", "the planner to miss the driver")
    assert "has said nothing for" in rig.said("reason")
    assert rig.nothing_more_comes()
    rig.client.watch([])
    rig.driver.signal(signal.SIGKILL)
    rig.wait(lambda: not rig.driver.alive, "its end")
    rig.command("late")
    rig.wait(lambda: rig.said("plan_id") == "late" and rig.said("state") == "refused", "refusal")
    assert not rig.received("late")
    rig.start_driver()
    rig.wait(lambda: rig.said("driver") == "DISARMED", "the new driver")
    rig.arm()
    rig.wait(lambda: rig.said("driver") == "ARMED", "the planner to hear of it")
    rig.play_plan("after")
