"""The recorder as a process on a graph."""

import itertools
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from bags import START, read_texts, spec
from rclpy.duration import Duration
from rclpy.serialization import serialize_message
from std_msgs.msg import Header

from der_planner.bags.reader import BagReader
from der_planner.bags.writer import BagWriter

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


def test_sigterm_closes_the_bag(graph, tmp_path: Path):
    talker = Talker(graph)
    talker.topic("talk")
    process = start(graph, output=str(tmp_path / "run"), autostart=True, topics="/limb/talk")
    talker.heard("talk")
    for index in range(20):
        talker.say("talk", f"word {index}")
    talker.arrived("talk")
    graph.client.watch([])
    assert process.stop() == 0
    assert read_texts(tmp_path / "run") == talker.sent


def test_what_a_stopped_recorder_missed_is_counted(graph, tmp_path: Path):
    from std_msgs.msg import UInt8MultiArray

    sender = graph.client.node.create_publisher(UInt8MultiArray, "data", 10)
    process = start(graph, output=str(tmp_path / "run"), autostart=True, topics="/limb/data")
    graph.client.wait_for(sender.get_subscription_count, 30.0, "the recorder")
    # The recorder counts once it has looked at the graph and knows that there is one sender.
    graph.client.spin(1.0)
    sent = 0

    def send(count: int) -> None:
        nonlocal sent
        for _ in range(count):
            sender.publish(UInt8MultiArray(data=bytes(20_000)))
            sent += 1
            graph.client.spin(0.005)

    send(10)
    process.signal(signal.SIGSTOP)
    send(400)
    process.signal(signal.SIGCONT)
    send(10)
    assert sender.wait_for_all_acked(Duration(seconds=30))
    graph.client.call("recorder/stop")
    with BagReader(tmp_path / "run") as bag:
        written = bag.topics["/limb/data"].message_count
    (line,) = [text for text in process.log.read_text().splitlines() if "closed" in text]
    missed = int(line.split(" missed")[0].split()[-1])
    assert missed > 0
    assert written + missed == sent


def test_a_bag_that_cannot_be_written_is_reported_at_once(graph, tmp_path: Path):
    from der_planner.experiment.processes import GraphError

    talker = Talker(graph)
    talker.topic("talk")
    process = start(graph, output=str(tmp_path / "run"), autostart=True, topics="/limb/talk")
    talker.heard("talk")
    shutil.rmtree(tmp_path / "run")
    graph.client.wait_for(lambda: "was removed" in process.log.read_text(), 30.0, "the log")
    graph.client.wait_for(lambda: value(graph, "state") == "failed", 30.0, "the failure")
    assert "was removed" in graph.client.diagnostics["recorder"].message
    (tmp_path / "run").write_text("a file is in the way")
    with pytest.raises(GraphError, match="cannot write a bag into"):
        graph.client.call("recorder/start")
    assert process.alive


def test_a_start_without_space_is_refused(graph, tmp_path: Path):
    from der_planner.experiment.processes import GraphError

    start(graph, output=str(tmp_path / "run"), minimum_free=1 << 60)
    with pytest.raises(GraphError, match=r"MiB are free where .*: nothing is recorded"):
        graph.client.call("recorder/start")


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


def test_stepping_waits_for_each_answer(graph, tmp_path: Path):
    from der_msgs.msg import LimbState
    from limb_interfaces import qos, stamps

    bag = BagWriter(tmp_path / "run")
    bag.add_topic(spec("/limb/asked", "der_msgs/msg/LimbState"))
    for index in range(20):
        message = LimbState(header=Header(stamp=stamps.stamp_from_nanoseconds(START + index)))
        bag.write("/limb/asked", START + index, START, serialize_message(message))
    bag.close()
    events: list[tuple[str, int]] = []
    answers = graph.client.node.create_publisher(LimbState, "answered", qos.STATES)

    def answer(message: LimbState) -> None:
        number = stamps.nanoseconds(message.header.stamp) - START
        events.append(("asked", number))
        if events.count(("asked", number)) == 1 and number == 7:
            return  # lost once: it is asked again
        graph.client.spin(0.01)
        events.append(("answered", number))
        answers.publish(message)

    graph.client.subscribe(LimbState, "asked", qos.STATES, answer)
    command = [sys.executable, str(SCRIPTS / "replay_bag.py"), str(tmp_path / "run")]
    command += ["--rate", "0", "--step-by", "/limb/asked=/limb/answered", "--wait", "30"]
    environment = {**os.environ, "ROS_DOMAIN_ID": str(graph.domain_id)}
    with subprocess.Popen(command, env=environment) as replay:
        graph.client.wait_for(lambda: replay.poll() is not None, 120.0, "the replay")
        assert replay.returncode == 0
    assert [number for what, number in events if what == "answered"] == list(range(20))
    assert events.count(("asked", 7)) == 2
    for before, after in itertools.pairwise(events):
        assert before[0] == "answered" or after[1] == before[1]


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
