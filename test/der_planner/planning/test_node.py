"""The planner node as a process: plans, streams, hands over, stops, refuses with a reason."""

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


def test_what_cannot_be_done_is_refused_with_a_reason(planner):
    from geometry_msgs.msg import Point, Pose, PoseStamped
    from nav_msgs.msg import Path

    node = planner()
    cases = [
        ({"motion": "jump"}, "motion 'jump' is unknown"),
        ({"model": "fem"}, "model 'fem' is unknown"),
        ({"model": "pcc", "method": "optimal"}, "no method 'optimal'"),
        ({"period": -1.0}, "period must be positive"),
        ({"amplitude": float("nan")}, "amplitude must be positive"),
        ({"motion": "same_direction", "amplitude": 1.7}, "out of reach"),
    ]
    for number, (fields, reason) in enumerate(cases):
        node.command(plan_id=f"bad {number}", **fields)
        node.client.wait_for(
            lambda number=number: (
                node.state().get("plan_id") == f"bad {number}"
                and node.state()["state"] == "refused"
            ),
            60.0,
            reason,
        )
        assert reason in node.state()["reason"]
    path = Path()
    path.header.frame_id = "limb_base"
    for x in (0.2, 0.5):
        path.poses.append(PoseStamped(pose=Pose(position=Point(x=x, y=0.1))))
    node.paths.publish(path)
    node.client.wait_for(lambda: "mm from what" in node.state()["reason"], 60.0, "a refusal")
    path.header.frame_id = "map"
    node.paths.publish(path)
    node.client.wait_for(lambda: "frame 'map'" in node.state()["reason"], 60.0, "a refusal")
    assert not node.plans
    assert not node.setpoints


def test_a_path_is_planned_and_a_new_command_takes_over_without_a_jump(planner):
    from geometry_msgs.msg import Point, Pose, PoseStamped
    from nav_msgs.msg import Path

    node = planner(path_speed=0.01)
    path = Path()
    for y in np.linspace(0.10, 0.13, 7):
        path.poses.append(PoseStamped(pose=Pose(position=Point(x=0.19, y=float(y)))))
    node.paths.publish(path)
    first = node.client.wait_for(lambda: node.plans and node.plans[0], 60.0, "the plan")
    assert first.motion == "path"
    node.client.wait_for(lambda: len(node.received(first.plan_id)) > 20, 60.0, "setpoints")
    node.command(plan_id="second")
    second = node.wait_plan("second")
    count = len(second.time)
    node.client.wait_for(lambda: len(node.received("second")) == count, 60.0, "the rest")
    messages = [m for _, m in node.setpoints]
    assert np.all(np.diff([stamp(m) for m in messages]) == 50_000_000)
    assert 20 < len(node.received(first.plan_id)) < len(first.time)
    pressures = np.array([m.differential_pressure for m in messages])
    assert np.abs(np.diff(pressures, axis=0)).max() <= 9000 * 0.05 + 1e-6


def test_start_and_stop(planner):
    from der_planner.experiment.errors import GraphError

    node = planner(auto_start=False)
    with pytest.raises(GraphError, match="no plan yet"):
        node.client.call("planner/start")
    node.command(plan_id="waits")
    plan = node.wait_plan("waits")
    node.wait_state("done")
    assert not node.setpoints
    node.client.call("planner/start")
    node.client.wait_for(lambda: len(node.received("waits")) > 3, 60.0, "setpoints")
    with pytest.raises(GraphError, match="is being played"):
        node.client.call("planner/start")
    assert "stopped streaming" in node.client.call("planner/stop")
    node.wait_state("idle")
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
