"""The twin as a process of the graph."""

import numpy as np
import pytest

from der_msgs.msg import ChamberPressures, LimbPush, LimbShape, LimbState
from limb_interfaces import qos, stamps, topics

pytestmark = pytest.mark.graph
ATMOSPHERE = 100_800.0


def test_hangs_carries_follows_the_newest_pressures_and_is_pushed(graph):
    shapes, truths, client = [], [], graph.client
    client.subscribe(LimbShape, topics.TWIN_SHAPE, qos.STATES, shapes.append)
    client.subscribe(LimbState, topics.TWIN_GROUND_TRUTH, qos.STATES, truths.append)
    pressures = client.node.create_publisher(
        ChamberPressures, topics.TWIN_CHAMBER_PRESSURES, qos.STATES
    )
    pushes = client.node.create_publisher(LimbPush, topics.TWIN_PUSH, qos.COMMANDS)
    loads = {"gravity": [0.0, -4.0, 0.0], "masses": [0.02], "masses_at": [0.244]}
    process = graph.start("der_planner", "limb_twin", seed=1, **loads)
    client.watch([process])
    for publisher in (pressures, pushes):
        client.wait_for(publisher.get_subscription_count, 60.0, "the twin to listen")

    def wait_tip(condition, what, gauge=0.0):
        def reached():
            pressures.publish(ChamberPressures(pressure=[ATMOSPHERE + gauge] + 3 * [ATMOSPHERE]))
            return len(truths) > 5 and condition(truths[-1].tip.y)

        client.wait_for(reached, 60.0, what)
        return truths[-1].tip.y

    sag = wait_tip(lambda y: y < -0.06, "the limb to hang under its load")
    # Half a newton upward lifts the tip; it begins at its instant and ends by itself.
    begin = client.node.get_clock().now().nanoseconds + stamps.NANOSECONDS
    push = LimbPush(arc_length=0.244, duration=1.0)
    push.force.y = 0.5
    push.header.stamp = stamps.stamp_from_nanoseconds(begin)
    pushes.publish(push)
    wait_tip(lambda y: y > sag + 0.04, "the limb to be lifted")
    assert stamps.nanoseconds(truths[-1].header.stamp) > begin
    wait_tip(lambda y: y < sag + 0.01, "the limb to sink again")
    wait_tip(lambda y: y > sag + 0.04, "a bend", gauge=8000.0)
    wait_tip(lambda y: y < sag + 0.01, "the limb to come back")
    assert np.all(np.diff([stamps.seconds(shape.header.stamp) for shape in shapes]) > 0)
    shape = shapes[-1]
    assert shape.header.frame_id == topics.BASE_FRAME
    assert len(shape.arc_length) == len(shape.points) == len(shape.heading)
    assert shape.arc_length[-1] == pytest.approx(0.244)
    assert process.stop(timeout=20.0) == 0
