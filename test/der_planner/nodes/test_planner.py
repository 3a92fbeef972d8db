"""The planner node as a process: plans, streams, hands over, stops, refuses with a reason."""

import subprocess

import numpy as np
import pytest

pytestmark = pytest.mark.graph


@pytest.fixture
def planner(graph):
    from geometry_msgs.msg import PointStamped
    from nav_msgs.msg import Path
    from visualization_msgs.msg import MarkerArray

    from der_msgs.msg import MotionCommand, PressurePlan, PressureSetpoint
    from limb_interfaces import qos, topics

    class Planner:
        def __init__(self, **parameters):
            self.client = graph.client
            self.setpoints, self.plans, self.tips, self.markers = [], [], [], []
            self.client.subscribe(
                PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINTS, self._keep
            )
            self.client.subscribe(PressurePlan, topics.PLAN, qos.LATCHED, self.plans.append)
            self.client.subscribe(
                PointStamped, topics.TIP_REFERENCE, qos.SETPOINTS, self.tips.append
            )
            self.client.subscribe(
                MarkerArray, topics.SHAPE_MARKERS, qos.STATES, self.markers.append
            )
            node = self.client.node
            self.commands = node.create_publisher(MotionCommand, topics.COMMAND, qos.COMMANDS)
            self.paths = node.create_publisher(Path, topics.PATH, qos.COMMANDS)
            self.process = graph.start("der_planner", "planner", **parameters)
            self.client.wait_ready(["planner"])
            for publisher in (self.commands, self.paths):
                self.client.wait_for(publisher.get_subscription_count, 30.0, "the planner")
            self.client.wait_for(
                lambda: self.client.node.count_publishers(topics.PRESSURE_SETPOINT), 30.0, "it"
            )

        def _keep(self, message):
            now = self.client.node.get_clock().now().nanoseconds
            self.setpoints.append((now, message))

        def command(self, motion="asynchronous", **fields):
            fields = {"model": "der", "amplitude": 0.3, "period": 3.0, "cycles": 1, **fields}
            self.commands.publish(MotionCommand(motion=motion, **fields))

        def state(self):
            return self.client.diagnostic_values("planner")

        def wait_reason(self, reason):
            self.client.wait_for(lambda: reason in self.state().get("reason", ""), 60.0, reason)

        def wait_plan(self, plan_id):
            return self.client.wait_for(
                lambda: next((p for p in self.plans if p.plan_id == plan_id), None), 60.0, plan_id
            )

        def wait_state(self, state):
            self.client.wait_for(lambda: self.state().get("state") == state, 60.0, state)
            return self.state()

        def received(self, plan_id):
            return [m for _, m in self.setpoints if m.plan_id == plan_id]

    return Planner


def stamp(message):
    from limb_interfaces.stamps import nanoseconds

    return nanoseconds(message.header.stamp)


def test_a_command_becomes_a_plan_and_timed_setpoints(planner):
    node = planner()
    node.command(plan_id="first", method="optimal")
    plan = node.wait_plan("first")
    count = len(plan.time)
    assert (plan.model, plan.method, plan.segment_count) == ("der", "optimal", 2)
    node.client.wait_for(lambda: len(node.received("first")) == count, 60.0, "the setpoints")
    messages = node.received("first")
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
    said = node.wait_state("done")
    assert said["plan_id"] == "first"
    assert node.process.stop() == 0


def test_each_plan_has_the_loads_of_its_time(planner):
    """By parameter, by command, and by a parameter that was set."""
    from rcl_interfaces.msg import Parameter, ParameterValue
    from rcl_interfaces.srv import SetParameters

    node = planner(payload=0.02, mounting="hanging", auto_start=False)

    def loads(plan_id, **fields):
        node.command(plan_id=plan_id, model="pcc", **fields)
        plan = node.wait_plan(plan_id)
        return plan.payload, plan.payload_at, *plan.gravity[:2]

    assert loads("parameters") == (0.02, 0.0, 9.81, 0.0)
    assert loads("heavier", payload=0.05, payload_at=0.2) == (0.05, 0.2, 9.81, 0.0)
    tilted = (0.03, 0.0, 0.0, pytest.approx(-1.7035, abs=1e-4))
    assert loads("tilted", payload=0.03, mounting="10") == tilted
    client = node.client.node.create_client(SetParameters, "planner/set_parameters")
    node.client.wait_for(client.service_is_ready, 30.0, "the parameters")
    nothing = Parameter(name="payload", value=ParameterValue(type=3, double_value=0.0))
    unknown = Parameter(name="paylod", value=ParameterValue(type=3, double_value=0.0))
    answer = client.call_async(SetParameters.Request(parameters=[nothing, unknown]))
    node.client.wait_for(answer.done, 30.0, "the answer")
    taken, refused = answer.result().results
    assert taken.successful
    assert not refused.successful
    assert "paylod" in refused.reason
    assert loads("bare") == (0.0, 0.0, 9.81, 0.0)


def test_start_and_stop(planner):
    from der_planner.experiment.processes import GraphError

    node = planner(auto_start=False)
    with pytest.raises(GraphError, match="no plan yet"):
        node.client.call("planner/start")
    node.command(plan_id="waits", period=30.0)
    plan = node.wait_plan("waits")
    node.wait_state("done")
    assert not node.setpoints
    node.client.call("planner/start")
    node.client.wait_for(lambda: len(node.received("waits")) > 3, 60.0, "setpoints")
    with pytest.raises(GraphError, match="is being played"):
        node.client.call("planner/start")
    assert "stopped streaming" in node.client.call("planner/stop")
    node.wait_state("idle")
    node.client.spin(0.3)  # what was on its way
    seen = len(node.setpoints)
    node.client.spin(0.5)
    assert len(node.setpoints) == seen < len(plan.time)


def test_a_bad_limb_file_ends_the_node_with_its_name(graph, tmp_path):
    file = tmp_path / "limb.yaml"
    file.write_text("schema_version: 1\nsegments: 3\n")
    process = graph.start("der_planner", "planner", limb_file=str(file))
    graph.client.wait_for(lambda: not process.alive, 60.0, "the node to give up")
    assert process.stop() != 0
    assert "limb.yaml" in process.last_words()


@pytest.mark.parametrize(("offset", "reason"), [(-1.7e9, "s ago"), (2.2e8, "s ahead")])
def test_a_start_in_another_epoch_is_refused(planner, offset, reason):
    from std_msgs.msg import Header

    from limb_interfaces.stamps import stamp_from_nanoseconds

    node = planner()
    now = node.client.node.get_clock().now().nanoseconds
    wrong = stamp_from_nanoseconds(now + round(offset * 1e9))
    node.command(plan_id="wrong", header=Header(stamp=wrong))
    node.wait_reason(reason)
    assert node.state()["state"] == "refused"
    assert not node.setpoints


def test_a_bad_command_leaves_the_plan_that_plays_alone(planner):
    node = planner()
    node.command(plan_id="good", period=30.0)  # longer than a refusal takes anywhere
    node.client.wait_for(lambda: node.received("good"), 60.0, "setpoints")
    node.command("jump", plan_id="bad")
    node.client.wait_for(lambda: node.state()["last_refusal"], 60.0, "the refusal")
    assert (node.state()["state"], node.state()["plan_id"]) == ("streaming", "good")
    assert "'jump' is unknown" in node.client.diagnostics["planner"].message
    heard = len(node.received("good"))
    node.client.wait_for(lambda: len(node.received("good")) > heard + 5, 60.0, "it to go on")
    node.command(plan_id="whole", period=1.0)
    node.wait_plan("whole")
    assert node.wait_state("done")["plan_id"] == "whole"
    node.process.stop()
    log = node.process.log.read_text()
    for words in ("plan good accepted", "plan good started", "plan whole finished after"):
        assert words in log


def test_setpoints_offer_liveliness_and_reach_plain_subscribers_and_publishers(planner):
    """Who asks for it is told of a killed planner; a publisher of plain QoS is still heard."""
    import signal

    from rclpy.duration import Duration
    from rclpy.event_handler import SubscriptionEventCallbacks
    from rclpy.qos import QoSProfile

    from der_msgs.msg import PressureSetpoint
    from limb_interfaces import topics

    node = planner()
    alive = []
    asks = QoSProfile(
        depth=10, deadline=Duration(seconds=1), liveliness_lease_duration=Duration(seconds=2)
    )
    node.client.node.create_subscription(
        PressureSetpoint,
        topics.PRESSURE_SETPOINT,
        lambda _: None,
        asks,
        event_callbacks=SubscriptionEventCallbacks(
            liveliness=lambda status: alive.append(status.alive_count)
        ),
    )
    node.client.wait_for(lambda: 1 in alive, 30.0, "a live planner")
    by_hand = node.client.node.create_publisher(PressureSetpoint, topics.PRESSURE_SETPOINT, 10)
    node.client.wait_for(by_hand.get_subscription_count, 30.0, "the plain subscriber")
    assert by_hand.get_subscription_count() == 1  # not the one that asks for more than is offered
    node.command(plan_id="killed")
    node.client.wait_for(lambda: node.received("killed"), 60.0, "setpoints")
    node.process.signal(signal.SIGKILL)
    node.client.wait_for(lambda: alive[-1] == 0, 30.0, "word of the planner's death")


def test_the_action_tells_how_it_goes_and_how_it_ended(planner):
    from rclpy.action import ActionClient

    from der_msgs.action import PlayMotion
    from der_msgs.msg import MotionCommand

    node = planner()
    action = ActionClient(node.client.node, PlayMotion, "planner/play_motion")
    node.client.wait_for(action.server_is_ready, 30.0, "the action")
    heard = []

    def play(motion="asynchronous", plan_id="", period=2.0, amplitude=0.3):
        command = MotionCommand(
            motion=motion, amplitude=amplitude, period=period, cycles=1, plan_id=plan_id
        )
        sent = action.send_goal_async(
            PlayMotion.Goal(command=command), lambda message: heard.append(message.feedback)
        )
        node.client.wait_for(sent.done, 30.0, "the goal to be accepted")
        handle = sent.result()
        return handle, handle.get_result_async() if handle.accepted else None

    def result_of(future):
        node.client.wait_for(future.done, 60.0, "the result")
        return future.result()

    handle, _ = play("jump")
    assert not handle.accepted
    node.client.wait_for(lambda: "'jump' is unknown" in node.state()["last_refusal"], 30.0, "why")

    _, refused = play(amplitude=1.7)
    answer = result_of(refused)
    assert answer.result.outcome == "refused"
    assert "out of reach" in answer.result.reason

    _, whole = play(plan_id="whole")
    answer = result_of(whole)
    assert (answer.result.outcome, answer.result.plan_id) == ("finished", "whole")
    assert np.isnan(answer.result.tip_error)  # nothing tracks the tip here
    told = [feedback.progress for feedback in heard if feedback.state == "streaming"]
    assert told == sorted(told)
    assert told[-1] > 0.9

    handle, cut = play(plan_id="cut", period=30.0)
    node.client.wait_for(lambda: node.received("cut"), 60.0, "setpoints")
    handle.cancel_goal_async()
    assert result_of(cut).result.outcome == "stopped"
    assert len(node.received("cut")) < len(node.wait_plan("cut").time)

    _, old = play(plan_id="old", period=30.0)
    node.client.wait_for(lambda: node.received("old"), 60.0, "setpoints")
    _, new = play("same_direction", plan_id="new")
    assert result_of(old).result.outcome == "replaced"
    assert result_of(new).result.outcome == "finished"


def test_a_second_node_of_a_name_ends_with_the_remedy_and_the_first_goes_on(graph):
    first = graph.start("der_planner", "recorder", "first")
    graph.client.wait_ready(["recorder"])
    second = graph.start("der_planner", "recorder", "second")
    graph.client.wait_for(lambda: not second.alive, 60.0, "the second one to give up")
    assert second.stop() == 1
    assert f":{first.pid}): end it first" in second.last_words()
    assert "/limb/recorder is running already" in second.last_words()
    assert first.alive


def test_what_no_parameter_took_is_said(planner, graph, tmp_path):
    from der_planner.experiment.processes import find_executable

    file = tmp_path / "of_another_limb.yaml"
    file.write_text("/lab7/planner:\n  ros__parameters: {nodes: 31}\n")
    node = planner(defualt_model="pcc")
    node.process.stop()
    log = node.process.log.read_text()
    assert "'defualt_model' is set, but /limb/planner has none: did you mean 'default_mod" in log
    assert "driver_timeout" not in log
    command = [str(find_executable("der_planner", "planner")), "--ros-args"]
    with (
        (tmp_path / "foreign.log").open("w+") as log,
        subprocess.Popen([*command, "--params-file", str(file)], stdout=log, stderr=log) as process,
    ):
        try:
            graph.client.wait_for(
                lambda: (
                    "nothing under /lab7/planner is for /limb/planner"
                    in (tmp_path / "foreign.log").read_text()
                ),
                60.0,
                "the warning",
            )
        finally:
            process.terminate()
        assert process.wait(30.0) == 0
