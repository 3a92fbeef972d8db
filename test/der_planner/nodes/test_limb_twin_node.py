"""The twin as a process of the graph."""

import numpy as np
import pytest

pytestmark = pytest.mark.graph
ATMOSPHERE = 100_800.0


def test_follows_the_newest_pressures(graph):
    from der_msgs.msg import ChamberPressures, LimbShape, LimbState
    from limb_interfaces import qos, stamps, topics

    shapes, truths = [], []
    node = graph.client.node
    node.create_subscription(LimbShape, "/limb/" + topics.TWIN_SHAPE, shapes.append, 10)
    node.create_subscription(LimbState, "/limb/" + topics.TWIN_GROUND_TRUTH, truths.append, 10)
    publisher = node.create_publisher(
        ChamberPressures, "/limb/" + topics.TWIN_CHAMBER_PRESSURES, qos.STATES
    )
    process = graph.start("der_planner", "limb_twin", seed=1)
    graph.client.watch([process])
    graph.client.wait_for(publisher.get_subscription_count, 60.0, "the twin to listen")

    def push(gauge: float):
        publisher.publish(ChamberPressures(pressure=[ATMOSPHERE + gauge] + 3 * [ATMOSPHERE]))

    def values() -> dict[str, str]:
        return graph.client.diagnostic_values("limb_twin")

    def first_angle() -> float:
        return np.degrees(truths[-1].bend_angle[0]) if truths else 0.0

    graph.client.wait_for(lambda: push(0.0) or len(shapes) > 10, 60.0, "shapes at rest")
    resting = first_angle()
    assert abs(resting) < 6.0
    graph.client.wait_for(lambda: push(8000.0) or first_angle() > resting + 12, 60.0, "a bend")
    graph.client.wait_for(
        lambda: push(0.0) or abs(first_angle() - resting) < 6.0, 60.0, "the limb to go back"
    )
    times = np.array([stamps.seconds(shape.header.stamp) for shape in shapes])
    assert np.all(np.diff(times) > 0)
    shape = shapes[-1]
    assert shape.header.frame_id == topics.BASE_FRAME
    assert len(shape.arc_length) == len(shape.points) == len(shape.heading)
    assert shape.arc_length[-1] == pytest.approx(0.244)
    publisher.publish(ChamberPressures(pressure=[ATMOSPHERE] * 3))
    graph.client.wait_for(lambda: "pressures_received" in values(), 30.0, "diagnostics")
    assert process.stop(timeout=20.0) == 0


def test_hangs_carries_and_is_pushed(graph):
    from der_msgs.msg import LimbPush, LimbState
    from limb_interfaces import qos, stamps, topics

    truths = []
    node = graph.client.node
    node.create_subscription(LimbState, "/limb/" + topics.TWIN_GROUND_TRUTH, truths.append, 10)
    pushes = node.create_publisher(LimbPush, "/limb/" + topics.TWIN_PUSH, qos.COMMANDS)
    loads = {"gravity": [0.0, -4.0, 0.0], "masses": [0.02], "masses_at": [0.244]}
    process = graph.start("der_planner", "limb_twin", seed=1, **loads)
    graph.client.watch([process])
    graph.client.wait_for(pushes.get_subscription_count, 60.0, "the twin to listen")
    graph.client.wait_for(lambda: len(truths) > 5, 60.0, "the shape at rest")
    sag = truths[-1].tip.y
    assert sag < -0.06
    # Half a newton upward lifts the tip; it begins at its instant and ends by itself.
    begin = node.get_clock().now().nanoseconds + 2 * stamps.NANOSECONDS
    push = LimbPush(arc_length=0.244, duration=1.0)
    push.force.y = 0.5
    push.header.stamp = stamps.stamp_from_nanoseconds(begin)
    pushes.publish(push)
    graph.client.wait_for(lambda: truths[-1].tip.y > sag + 0.04, 60.0, "the limb to be lifted")
    lifted = [t.header.stamp for t in truths if t.tip.y > sag + 0.002]
    assert stamps.nanoseconds(lifted[0]) > begin
    graph.client.wait_for(lambda: truths[-1].tip.y < sag + 0.01, 60.0, "the limb to sink again")
    assert process.stop(timeout=20.0) == 0
