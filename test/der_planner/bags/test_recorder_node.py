"""The recorder as a process on a graph."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from bags import read_texts
from rclpy.duration import Duration

from der_planner.bags.reader import BagReader
from der_planner.bags.recover import recover_bag

pytestmark = pytest.mark.graph
SCRIPTS = Path(__file__).resolve().parents[3] / "scripts"


class Talker:
    """Publishers of Strings and of an image, and what they sent."""

    def __init__(self, graph) -> None:
        from std_msgs.msg import String

        from limb_interfaces import qos

        self.graph, self.qos, self.kind = graph, qos, String
        self.sent: list[str] = []
        self.publishers = {}

    def topic(self, name: str, profile=None):
        self.publishers[name] = self.graph.client.node.create_publisher(
            self.kind, name, profile or self.qos.STATES
        )

    def say(self, name: str, text: str) -> None:
        self.publishers[name].publish(self.kind(data=text))
        self.sent.append(text)

    def arrived(self, name: str) -> None:
        """Wait until what was said is with the recorder, which may not have looked at it."""
        assert self.publishers[name].wait_for_all_acked(Duration(seconds=30))

    def heard(self, *names: str) -> None:
        """Wait until the recorder listens to the topics."""
        for name in names:
            self.graph.client.wait_for(
                lambda name=name: self.publishers[name].get_subscription_count() > 0,
                30.0,
                f"a subscription of {name}",
            )


def start(graph, **parameters):
    process = graph.start("der_planner", "recorder", **parameters)
    graph.client.watch([process])
    graph.client.wait_ready(["recorder"])
    return process


def value(graph, key: str) -> str:
    return graph.client.diagnostic_values("recorder").get(key, "")


def test_records_the_graph_between_start_and_stop(graph, tmp_path: Path):
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import Image
    from std_srvs.srv import SetBool

    talker = Talker(graph)
    talker.topic("latched", talker.qos.LATCHED)
    talker.topic("fast", QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT))
    image = graph.client.node.create_publisher(Image, "camera/image_raw", talker.qos.SENSOR_DATA)
    graph.client.node.create_publisher(talker.kind, "moves/_action/feedback", 1)
    talker.say("latched", "the plan")
    folder = tmp_path / "run"
    process = start(graph, output=str(folder), metadata='{"motion": "circle", "trial": 3}')
    talker.heard("latched", "fast")
    talker.arrived("latched")

    talker.publishers["fast"].publish(talker.kind(data="before the start"))
    assert graph.client.call("recorder/start") == str(folder)
    for index in range(20):
        talker.say("fast", f"fast {index}")
        image.publish(Image(data=b"123"))
        graph.client.spin(0.01)

    talker.topic("late")  # appears while recording
    talker.heard("late")
    talker.say("late", "late one")
    graph.client.wait_for(lambda: int(value(graph, "messages") or 0) >= 22, 30.0, "messages")

    pause = graph.client.node.create_client(SetBool, "recorder/pause")
    graph.client.wait_for(pause.service_is_ready, 30.0, "pause")
    future = pause.call_async(SetBool.Request(data=True))
    graph.client.wait_for(future.done, 30.0, "pause")
    talker.publishers["late"].publish(talker.kind(data="in the pause"))
    talker.arrived("late")
    assert graph.client.call("recorder/mark") == "mark 1"
    future = pause.call_async(SetBool.Request(data=False))
    graph.client.wait_for(future.done, 30.0, "going on")
    talker.say("late", "after the pause")
    talker.arrived("late")
    assert graph.client.call("recorder/stop") == str(folder)

    texts = read_texts(folder)
    assert texts[0] == "the plan"
    assert [t for t in texts if t.startswith("fast")] == [f"fast {i}" for i in range(20)]
    assert [t for t in texts if "late" in t or "pause" in t] == ["late one", "after the pause"]
    assert "mark 1" in texts
    assert "before the start" not in texts
    with BagReader(folder) as bag:
        assert bag.run() == {"motion": "circle", "trial": 3}
        assert "/limb/camera/image_raw" not in bag.topics
        assert "/limb/moves/_action/feedback" not in bag.topics
        assert "/diagnostics" in bag.topics
        assert bag.topics["/limb/latched"].latched
        assert not bag.topics["/limb/fast"].reliable
    assert process.stop() == 0


def test_second_start_into_the_same_folder_is_refused(graph, tmp_path: Path):
    from der_planner.experiment.processes import GraphError

    start(graph, output=str(tmp_path / "run"))
    graph.client.call("recorder/start")
    with pytest.raises(GraphError, match="already recording"):
        graph.client.call("recorder/start")
    graph.client.call("recorder/stop")
    with pytest.raises(GraphError, match="not empty: name another"):
        graph.client.call("recorder/start")
    with pytest.raises(GraphError, match=r"not empty|not recording"):
        graph.client.call("recorder/stop")


def test_sigterm_closes_and_sigkill_loses_what_was_not_flushed(graph, tmp_path: Path):
    talker = Talker(graph)
    talker.topic("talk")
    for name in ("term", "kill"):
        # The recorder that has just ended is still counted for a moment.
        talking = talker.publishers["talk"].get_subscription_count
        graph.client.wait_for(
            lambda talking=talking: talking() == 0, 60.0, "no recorder to be left"
        )
        folder = tmp_path / name
        graph.client.diagnostics.clear()
        process = start(
            graph, output=str(folder), autostart=True, flush_interval=0.5, topics="/limb/talk"
        )
        talker.heard("talk")
        said: list[str] = []
        written: list[tuple[float, int]] = []

        def old(written=written) -> int:
            """Return how many messages were written two seconds ago, or earlier."""
            ago = time.monotonic() - 2.0
            return max((count for when, count in written if when < ago), default=0)

        def more(name=name, said=said, written=written, old=old) -> bool:
            said.append(f"{name} {len(said)}")
            talker.publishers["talk"].publish(talker.kind(data=said[-1]))
            graph.client.spin(0.02)
            written.append((time.monotonic(), int(value(graph, "messages") or 0)))
            return old() > 0 if name == "kill" else written[-1][1] > 0

        graph.client.wait_for(more, 60.0, "messages in the bag")
        graph.client.watch([])
        if name == "term":
            talker.arrived("talk")
            assert process.stop() == 0
            assert read_texts(folder) == said
            continue
        # Half a second between flushes, and what a busy machine adds.
        safe = old()
        process.signal(signal.SIGKILL)
        process.stop()
        recover_bag(folder)
        kept = read_texts(folder)
        assert kept == said[: len(kept)]
        assert len(kept) >= safe > 0


def test_removed_folder_is_reported_and_node_lives_on(graph, tmp_path: Path):
    talker = Talker(graph)
    talker.topic("talk")
    process = start(graph, output=str(tmp_path / "run"), autostart=True, topics="/limb/talk")
    talker.heard("talk")
    talker.say("talk", "kept")
    graph.client.wait_for(lambda: int(value(graph, "messages") or 0) > 0, 30.0, "a message")
    shutil.rmtree(tmp_path / "run")
    graph.client.wait_for(lambda: value(graph, "state") == "failed", 30.0, "the failure")
    assert "was removed" in graph.client.diagnostics["recorder"].message
    assert process.alive
    assert "kept" in read_texts(tmp_path / "run")


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"topics": "(["}, "parameter 'topics' is '(['"),
        ({"compression": "rar"}, "parameter 'compression'"),
        ({"metadata": "{broken", "autostart": True}, "parameter 'metadata' is no JSON"),
    ],
)
def test_bad_parameters_end_the_node_by_name(graph, parameters, message):
    process = graph.start("der_planner", "recorder", **parameters)
    graph.client.wait_for(lambda: not process.alive, 60.0, "the end of the node")
    assert process.exit_code == 1
    assert message in process.log.read_text()


def test_replay_publishes_the_recorded_bytes(graph, tmp_path: Path):
    talker = Talker(graph)
    talker.topic("talk")
    start(graph, output=str(tmp_path / "run"), topics="/limb/talk")
    talker.heard("talk")
    graph.client.call("recorder/start")
    for index in range(10):
        talker.say("talk", f"word {index}")
    talker.arrived("talk")
    graph.client.call("recorder/stop")

    heard: list[str] = []
    graph.client.subscribe(
        talker.kind, "again", talker.qos.STATES, lambda message: heard.append(message.data)
    )
    command = [sys.executable, str(SCRIPTS / "replay_bag.py"), str(tmp_path / "run")]
    command += ["--rate", "0", "--remap", "/limb/talk=/limb/again", "--wait", "30"]
    environment = {**os.environ, "ROS_DOMAIN_ID": str(graph.domain_id)}
    with subprocess.Popen(command, env=environment) as replay:
        graph.client.wait_for(lambda: len(heard) == 10, 60.0, "the replay")
        assert replay.wait(30.0) == 0
    assert heard == [f"word {index}" for index in range(10)]
    late = subprocess.run(
        [*command, "--from", "1000"], env=environment, capture_output=True, text=True, check=False
    )
    assert late.returncode == 1
    assert "nothing was published" in late.stderr


def test_recorded_images_give_the_same_states_at_every_replay(graph, tmp_path: Path):
    folder = tmp_path / "run"
    film(graph, folder, count=12)
    first, second = (track(graph, folder, name) for name in ("one", "two"))
    assert len(first) > 8  # images are best effort: a loaded machine may lose one
    assert sum(valid for _, valid, *_ in first) > 8
    assert repr(first) == repr(second)  # bit for bit, and NaN is NaN


def film(graph, folder: Path, count: int) -> None:
    """Record frames of the synthetic camera of a bending limb."""
    import numpy as np
    from geometry_msgs.msg import Point
    from sensor_msgs.msg import Image

    from apriltag_tracker.synthetic.shapes import constant_curvature
    from der_msgs.msg import LimbShape
    from limb_interfaces import qos, stamps, topics

    camera = graph.start("apriltag_tracker", "synthetic_camera")
    recorder = start(graph, output=str(folder), record_images=True)
    graph.client.wait_for(
        lambda: "synthetic_camera" in graph.client.diagnostics, 90.0, "the camera's compilation"
    )
    graph.client.subscribe(Image, topics.IMAGE, qos.IMAGES)
    shapes = graph.client.node.create_publisher(LimbShape, topics.TWIN_SHAPE, qos.STATES)
    graph.client.wait_for(lambda: shapes.get_subscription_count() >= 2, 30.0, "the camera")
    graph.client.call("recorder/start")
    for index in range(count):
        shape = constant_curvature((0.122, 0.122), [0.05 * index, 0.03 * index])
        message = LimbShape(
            arc_length=np.asarray(shape.arc_length).tolist(),
            points=[Point(x=float(x), y=float(y)) for x, y in shape.points],
            heading=np.asarray(shape.heading).tolist(),
        )
        message.header.stamp = stamps.stamp_from_nanoseconds(10**18 + index * 33_000_000)
        shapes.publish(message)
        graph.client.wait_for(
            lambda stamp=message.header.stamp: (
                topics.IMAGE in graph.client.newest
                and graph.client.newest[topics.IMAGE].header.stamp == stamp
            ),
            30.0,
            "the frame",
        )
    graph.client.spin(0.5)
    graph.client.call("recorder/stop")
    camera.stop()
    recorder.stop()
    graph.client.watch([])


def track(graph, folder: Path, name: str) -> list[tuple]:
    """Replay the images through a new tracker and return its states."""
    from der_msgs.msg import LimbState
    from limb_interfaces import qos

    states: list[tuple] = []

    def keep(message: LimbState) -> None:
        tip = (message.tip.x, message.tip.y)
        states.append((message.header.stamp.nanosec, message.valid, *tip, *message.bend_angle))

    graph.client.subscribe(LimbState, "state", qos.STATES, keep)
    graph.client.diagnostics.clear()
    tracker = graph.start("apriltag_tracker", "apriltag_tracker", name=f"tracker_{name}")
    graph.client.wait_for(
        lambda: "apriltag_tracker" in graph.client.diagnostics, 90.0, "the tracker"
    )
    command = [sys.executable, str(SCRIPTS / "replay_bag.py"), str(folder), "--rate", "0"]
    command += ["--topics", "/limb/camera/image_raw", "/limb/camera/camera_info"]
    command += ["--step-by", "/limb/camera/image_raw=/limb/state", "--wait", "30"]
    environment = {**os.environ, "ROS_DOMAIN_ID": str(graph.domain_id)}
    with subprocess.Popen(command, env=environment) as replay:
        graph.client.wait_for(lambda: replay.poll() is not None, 120.0, "the replay")
        assert replay.returncode == 0
    graph.client.wait_for(lambda: states, 30.0, "states")
    graph.client.spin(0.5)
    tracker.stop()
    return list(states)


def test_a_recorder_with_another_name_has_its_parameters_and_its_own_services(graph, tmp_path):
    """Its parameter services are rclpy's, made with the node; `ros2 param list` asks them."""
    from rcl_interfaces.srv import ListParameters

    graph.start(
        "der_planner",
        "recorder",
        "second",
        {"__node": "rec2"},
        output=str(tmp_path / "run"),
        recrod_images=True,
    )
    graph.client.wait_ready(["rec2"])
    client = graph.client.node.create_client(ListParameters, "rec2/list_parameters")
    graph.client.wait_for(client.service_is_ready, 30.0, "the parameter services")
    future = client.call_async(ListParameters.Request())
    graph.client.wait_for(future.done, 30.0, "the parameters")
    assert {"output", "record_images", "topics"} <= set(future.result().result.names)
    assert graph.client.call("rec2/start") == str(tmp_path / "run")
    graph.client.call("rec2/stop")
    log = (tmp_path / "second.log").read_text()
    assert "'recrod_images' is set, but /limb/rec2 has none: did you mean 'record_images'?" in log


def test_states_that_were_never_sent_are_not_taken_for_lost(graph, tmp_path):
    from der_msgs.msg import LimbState
    from limb_interfaces import qos, stamps, topics

    start(graph, output=str(tmp_path / "run"), autostart=True)
    states = graph.client.node.create_publisher(LimbState, topics.LIMB_STATE, qos.STATES)
    graph.client.wait_for(states.get_subscription_count, 30.0, "the recorder")
    for index in range(60):
        if index % 3 == 2 or index < 10:  # as a camera that leaves out two of three
            message = LimbState()
            message.header.stamp = stamps.stamp_from_nanoseconds(10**15 + index * 33_333_333)
            states.publish(message)
            graph.client.spin(0.01)
    graph.client.wait_for(lambda: value(graph, "unsent"), 30.0, "the count")
    graph.client.wait_for(lambda: value(graph, "unsent") == "/limb/state: 33", 30.0, "all of them")
    assert "left out by a sender" in graph.client.diagnostics["recorder"].message
    assert value(graph, "missed") == ""
