"""The planner node as a process: plans, streams, hands over, stops, refuses with a reason."""

import numpy as np
import pytest
from geometry_msgs.msg import PointStamped
from rclpy.action import ActionClient
from rclpy.duration import Duration
from visualization_msgs.msg import MarkerArray

from der_msgs.action import PlayMotion
from der_msgs.msg import MotionCommand, PressurePlan, PressureSetpoint, PressureState
from der_planner.experiment.processes import GraphError
from limb_interfaces import qos, topics
from limb_interfaces.stamps import nanoseconds

pytestmark = pytest.mark.graph


class Planner:
    """A planner and all that it publishes."""

    def __init__(self, graph, **parameters):
        self.client = graph.client
        self.setpoints, self.plans, self.tips, self.markers = [], [], [], []
        subscribe = self.client.subscribe
        subscribe(PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINTS, self._keep)
        subscribe(PressurePlan, topics.PLAN, qos.LATCHED, self.plans.append)
        subscribe(PointStamped, topics.TIP_REFERENCE, qos.SETPOINTS, self.tips.append)
        subscribe(MarkerArray, topics.SHAPE_MARKERS, qos.STATES, self.markers.append)
        node = self.client.node
        self.commands = node.create_publisher(MotionCommand, topics.COMMAND, qos.COMMANDS)
        self.process = graph.start("der_planner", "planner", **parameters)
        self.client.wait_ready(["planner"])
        self.client.wait_for(self.commands.get_subscription_count, 30.0, "the planner")
        self.client.wait_for(lambda: node.count_publishers(topics.PRESSURE_SETPOINT), 30.0, "it")
        self.action = ActionClient(node, PlayMotion, "planner/play_motion")

    def _keep(self, message):
        now = self.client.node.get_clock().now().nanoseconds
        self.setpoints.append((now, message))

    def command(self, motion="asynchronous", **fields):
        fields = {"model": "der", "amplitude": 0.3, "period": 3.0, "cycles": 1, **fields}
        self.commands.publish(MotionCommand(motion=motion, **fields))

    def ask(self, heard=lambda _: None, **fields):
        """Send a goal; return its handle, and the future of its result if it was accepted."""
        self.client.wait_for(self.action.server_is_ready, 30.0, "the action")
        fields = {"motion": "asynchronous", "amplitude": 0.3, "cycles": 1, **fields}
        goal = PlayMotion.Goal(command=MotionCommand(**fields))
        sent = self.action.send_goal_async(goal, lambda message: heard(message.feedback))
        self.client.wait_for(sent.done, 30.0, "the goal to be accepted")
        handle = sent.result()
        return handle, handle.get_result_async() if handle.accepted else None

    def result_of(self, future):
        self.client.wait_for(future.done, 60.0, "the result")
        return future.result().result

    def state(self):
        return self.client.diagnostic_values("planner")

    def wait_plan(self, plan_id):
        return self.client.wait_for(
            lambda: next((p for p in self.plans if p.plan_id == plan_id), None), 60.0, plan_id
        )

    def wait_state(self, state):
        self.client.wait_for(lambda: self.state().get("state") == state, 60.0, state)
        return self.state()

    def wait_refusal(self, words):
        self.client.wait_for(lambda: words in self.state()["last_refusal"], 30.0, "the refusal")

    def received(self, plan_id):
        return [m for _, m in self.setpoints if m.plan_id == plan_id]


@pytest.fixture(scope="module")
def running(module_graph):
    return Planner(module_graph)


@pytest.fixture
def plain(running):
    """A planner with the parameters that it has by itself; tests in the order of this file."""
    for kept in (running.setpoints, running.plans):
        kept.clear()
    return running


def stamp(message):
    return nanoseconds(message.header.stamp)


def test_a_command_becomes_a_plan_and_timed_setpoints_that_are_started_and_stopped(graph):
    node = Planner(graph, payload=0.02, mounting="hanging", auto_start=False)
    with pytest.raises(GraphError, match="no plan yet"):
        node.client.call("planner/start")
    node.command(plan_id="first", method="optimal")
    plan = node.wait_plan("first")
    count = len(plan.time)
    node.wait_state("done")
    assert not node.setpoints
    node.client.call("planner/start")
    assert (plan.model, plan.method, plan.segment_count) == ("der", "optimal", 2)
    assert (plan.payload, plan.payload_at, *plan.gravity) == (0.02, 0.0, 9.81, 0.0, 0.0)
    node.client.wait_for(lambda: len(node.received("first")) == count, 60.0, "the setpoints")
    messages, plan = node.received("first"), node.plans[-1]
    assert [m.index for m in messages] == list(range(count))
    assert stamp(messages[0]) == stamp(plan)
    assert all(stamp(m) % 50_000_000 == 0 for m in messages)
    assert np.all(np.diff([stamp(m) for m in messages]) == 50_000_000)
    sent = np.array([m.differential_pressure for m in messages])
    np.testing.assert_array_equal(sent.ravel(), plan.differential_pressure)
    ahead = [stamp(m) - now for now, m in node.setpoints]
    assert max(ahead) <= 200_000_000
    node.client.wait_for(lambda: len(node.tips) == count, 60.0, "the tip references")
    tips = np.array([(m.point.x, m.point.y) for m in node.tips])
    np.testing.assert_array_equal(tips.ravel(), plan.tip_reference)
    names = {marker.ns for message in node.markers for marker in message.markers}
    assert names == {"planner/reference_path", "planner/predicted_path", "planner/limb"}
    assert node.wait_state("done")["plan_id"] == "first"
    (offered,) = node.client.node.get_publishers_info_by_topic("/limb/pressure_setpoint")
    assert offered.qos_profile.liveliness_lease_duration == Duration(seconds=1)

    node.command(plan_id="waits", period=30.0)
    plan = node.wait_plan("waits")
    node.wait_state("done")
    node.client.call("planner/start")
    node.client.wait_for(lambda: len(node.received("waits")) > 3, 60.0, "setpoints")
    with pytest.raises(GraphError, match="is being played"):
        node.client.call("planner/start")
    assert "stopped streaming" in node.client.call("planner/stop")
    node.wait_state("idle")
    assert len(node.received("waits")) < len(plan.time)
    node.client.call("planner/start")
    node.wait_state("streaming")
    assert node.process.stop() == 0


def test_the_action_tells_how_it_goes_and_how_it_ended(plain):
    node, heard = plain, []
    handle, _ = node.ask(motion="jump")
    assert not handle.accepted
    node.wait_refusal("'jump' is unknown")

    _, refused = node.ask(amplitude=1.7, period=2.0)
    result = node.result_of(refused)
    assert result.outcome == "refused"
    assert "out of reach" in result.reason

    _, whole = node.ask(heard.append, plan_id="whole", period=2.0)
    result = node.result_of(whole)
    assert (result.outcome, result.plan_id) == ("finished", "whole")
    assert np.isnan(result.tip_error)  # nothing tracks the tip here
    told = [feedback.progress for feedback in heard if feedback.state == "streaming"]
    assert told == sorted(told)
    assert told[-1] > 0.9

    handle, cut = node.ask(plan_id="cut", period=30.0)
    node.client.wait_for(lambda: node.received("cut"), 60.0, "setpoints")
    handle.cancel_goal_async()
    assert node.result_of(cut).outcome == "stopped"
    assert len(node.received("cut")) < len(node.wait_plan("cut").time)


def test_a_bad_command_leaves_the_plan_that_plays_alone(plain):
    node = plain
    node.command(plan_id="good", period=30.0)  # longer than a refusal takes anywhere
    node.client.wait_for(lambda: node.received("good"), 60.0, "setpoints")
    node.command("jump", plan_id="bad")
    node.wait_refusal("plan bad")
    assert (node.state()["state"], node.state()["plan_id"]) == ("streaming", "good")
    assert "'jump' is unknown" in node.client.diagnostics["planner"].message
    heard = len(node.received("good"))
    node.client.wait_for(lambda: len(node.received("good")) > heard + 5, 60.0, "it to go on")
    node.client.call("planner/stop")


class Driver:
    """Stands in for the driver: tells its mode 20 times a second, until it is silenced."""

    def __init__(self, node):
        self.node, self.mode = node, PressureState.DISARMED
        talker = node.client.node
        driver = talker.create_publisher(PressureState, topics.PRESSURE_STATE, qos.STATES)

        def tick():
            state = PressureState(mode=self.mode)
            state.header.stamp = talker.get_clock().now().to_msg()
            driver.publish(state)

        self.ticking = talker.create_timer(0.05, tick)
        self.become("DISARMED")

    def become(self, name):
        """Change the mode, and wait until the planner has heard of it."""
        self.mode = getattr(PressureState, name)
        self.node.client.wait_for(lambda: self.node.state()["driver"] == name, 30.0, name)


def test_a_plan_belongs_to_the_arming_in_which_it_was_asked_for(plain):
    """Asked for while disarmed, by topic or action, it is refused at once and never plays."""
    node, driver = plain, Driver(plain)
    node.command(plan_id="early", period=60.0)
    node.wait_refusal("early: the driver is DISARMED")
    result = node.result_of(node.ask(period=60.0)[1])
    assert result.outcome == "refused"
    assert "DISARMED" in result.reason

    driver.become("ARMED")
    node.command(plan_id="halted", period=600.0)  # it takes longer to plan than to disarm
    node.client.wait_for(lambda: node.state()["plan_id"] == "halted", 30.0, "it to be planned")
    driver.mode = PressureState.FAULT
    node.wait_refusal("halted: the driver is in FAULT")
    driver.become("ARMED")
    node.command(plan_id="later", period=2.0)
    node.wait_state("done")
    assert {message.plan_id for _, message in node.setpoints} == {"later"}
    assert {plan.plan_id for plan in node.plans} == {"later"}
    driver.ticking.cancel()


def test_a_driver_that_vents_or_is_silent_is_sent_nothing_more(plain):
    node, client, driver = plain, plain.client, Driver(plain)
    driver.become("ARMED")
    node.command(plan_id="old", period=30.0)
    client.wait_for(lambda: node.received("old"), 60.0, "setpoints")
    driver.mode = PressureState.DISARMED
    node.wait_state("vented")
    driver.become("ARMED")
    node.wait_state("idle")
    sent = len(node.received("old"))
    node.command(plan_id="old")  # it needs another name
    node.wait_refusal("give the command another plan_id")
    client.call("planner/start")
    again = client.wait_for(lambda: node.received("old-2"), 60.0, "the plan under a new name")
    assert again[0].index == 0
    assert node.plans[-1].plan_id == "old-2"

    driver.ticking.cancel()
    node.wait_state("lost")
    node.command(plan_id="silent", period=600.0)
    node.wait_refusal("silent: the driver has said nothing for")
    result = node.result_of(node.ask(period=60.0)[1])
    assert result.outcome == "refused"
    sent_again = len(node.received("old-2"))  # what was under way has come by now
    client.spin(1.0)
    assert (len(node.received("old")), len(node.received("old-2"))) == (sent, sent_again)
    log = node.process.log.read_text()
    assert "plan silent accepted" not in log
    assert f"plan {result.plan_id} accepted" not in log
