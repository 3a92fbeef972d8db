"""The recorder on a graph, in the process of the test; replays as people start them."""

import itertools
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import rclpy
import yaml
from bags import START, TEXT, read_texts, spec, string
from domain import own_domain
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image
from std_msgs.msg import Header, String, UInt8MultiArray
from std_srvs.srv import Trigger

from der_planner.bags.reader import BagReader
from der_planner.bags.writer import BagWriter
from der_planner.nodes.recorder import Recorder
from limb_interfaces import qos
from limb_interfaces.parameters import ParameterError

pytestmark = pytest.mark.graph
SCRIPTS = Path(__file__).resolve().parents[3] / "scripts"


class Bench:
    """A recorder and a node that talks to it; both are served while something is waited for."""

    def __init__(self, folder: Path, **parameters) -> None:
        file = folder / "parameters.yaml"
        content = {"/limb/recorder": {"ros__parameters": parameters}}
        file.write_text(yaml.safe_dump(content))
        line = ["--ros-args", "--params-file", str(file)]
        rclpy.init(args=line, domain_id=own_domain(__file__))
        self.executor = SingleThreadedExecutor()
        self.node = Node("talker", namespace="limb", use_global_arguments=False)
        self.executor.add_node(self.node)
        self.recorder = Recorder()
        self.executor.add_node(self.recorder)

    def wait_for(self, condition) -> None:
        deadline = self.node.get_clock().now() + Duration(seconds=60)
        while not condition():
            assert self.node.get_clock().now() < deadline
            self.executor.spin_once(timeout_sec=0.05)

    def call(self, name: str):
        client = self.node.create_client(Trigger, f"recorder/{name}")
        self.wait_for(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.wait_for(future.done)
        return future.result()

    def talk(self, topic: str, profile=qos.STATES, kind=String):
        """Return a publisher that the recorder has found."""
        publisher = self.node.create_publisher(kind, topic, profile)
        self.wait_for(publisher.get_subscription_count)
        return publisher

    def health(self):
        return self.recorder._health()

    def written(self) -> int:
        return int(self.health().values.get("recorded", 0))


@pytest.fixture
def bench(tmp_path: Path):
    made = []

    def make(**parameters) -> Bench:
        made.append(Bench(tmp_path, output=str(tmp_path / "run"), **parameters))
        return made[0]

    yield make
    for each in made:
        each.recorder.close()
        each.executor.shutdown()
    rclpy.try_shutdown()


def test_records_the_graph_between_start_and_stop(bench, tmp_path: Path):
    graph = bench(metadata='{"motion": "circle", "trial": 3}')
    latched = graph.talk("latched", qos.LATCHED)
    latched.publish(String(data="the plan"))
    fast = graph.talk("fast", qos.SENSOR_DATA)
    image = graph.node.create_publisher(Image, "camera/image_raw", qos.SENSOR_DATA)
    graph.node.create_publisher(String, "moves/_action/feedback", 1)
    fast.publish(String(data="before the start"))
    assert "not recording" in graph.call("stop").message

    assert graph.call("start").message == str(tmp_path / "run")
    again = graph.call("start")
    assert not again.success
    assert "already recording" in again.message
    for index in range(20):
        fast.publish(String(data=f"fast {index}"))
        image.publish(Image(data=b"123"))
        graph.executor.spin_once(timeout_sec=0.0)
    late = graph.talk("late")  # appears while recording
    late.publish(String(data="late one"))
    graph.wait_for(lambda: graph.written() >= 22)
    late.publish(String(data="late two"))
    assert late.wait_for_all_acked(Duration(seconds=30))
    assert graph.call("stop").message == str(tmp_path / "run")
    assert "not empty: name another" in graph.call("start").message

    texts = read_texts(tmp_path / "run")
    assert texts[0] == "the plan"
    assert [t for t in texts if t.startswith("fast")] == [f"fast {i}" for i in range(20)]
    assert [t for t in texts if "late" in t] == ["late one", "late two"]
    assert "before the start" not in texts
    with BagReader(tmp_path / "run") as bag:
        assert bag.run() == {"motion": "circle", "trial": 3}
        assert "/limb/camera/image_raw" not in bag.topics
        assert "/limb/moves/_action/feedback" not in bag.topics
        assert "/diagnostics" in bag.topics
        assert bag.topics["/limb/latched"].latched
        assert not bag.topics["/limb/fast"].reliable


def test_the_end_of_the_node_closes_the_bag(bench, tmp_path: Path):
    graph = bench(autostart=True, topics="/limb/talk")
    talk = graph.talk("talk")
    for index in range(20):
        talk.publish(String(data=f"word {index}"))
    assert talk.wait_for_all_acked(Duration(seconds=30))
    graph.recorder.close()
    assert read_texts(tmp_path / "run") == [f"word {index}" for index in range(20)]


def test_what_a_stopped_recorder_missed_is_counted(bench, tmp_path: Path):
    graph = bench(topics="/limb/data")
    data = graph.talk("data", 10, UInt8MultiArray)
    assert graph.call("start").success
    sent = 0

    def send(count: int) -> None:
        nonlocal sent
        for _ in range(count):
            data.publish(UInt8MultiArray(data=bytes(1000)))
            sent += 1

    send(1)
    graph.wait_for(lambda: graph.written() == 1)
    send(400)  # meanwhile nobody serves the recorder
    assert data.wait_for_all_acked(Duration(seconds=30))
    assert graph.call("stop").success
    with BagReader(tmp_path / "run") as bag:
        written = bag.topics["/limb/data"].message_count
    missed = int(graph.health().values["missed"].removeprefix("/limb/data: "))
    assert missed > 0
    assert written + missed == sent


def test_a_bag_that_cannot_be_written_is_reported_at_once(bench, tmp_path: Path):
    graph = bench(autostart=True, topics="/limb/talk")
    shutil.rmtree(tmp_path / "run")
    graph.wait_for(lambda: graph.health().values["state"] == "failed")
    assert "was removed" in graph.health().message
    (tmp_path / "run").write_text("a file is in the way")
    refused = graph.call("start")
    assert not refused.success
    assert "cannot write a bag into" in refused.message


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"topics": "(["}, r"parameter 'topics' is '\(\['"),
        ({"compression": "rar"}, "parameter 'compression'"),
        ({"metadata": "{broken", "autostart": True}, "parameter 'metadata' is no JSON"),
    ],
)
def test_bad_parameters_are_refused_by_name(bench, parameters, message):
    with pytest.raises(ParameterError, match=message):
        bench(**parameters)


def test_replay_publishes_the_recorded_bytes_and_waits_for_answers(graph, tmp_path: Path):
    from der_msgs.msg import LimbState
    from limb_interfaces import stamps

    bag = BagWriter(tmp_path / "run")
    asked, talk = spec("/limb/asked", "der_msgs/msg/LimbState"), spec("/limb/talk", TEXT)
    for index in range(20):
        message = LimbState(header=Header(stamp=stamps.stamp_from_nanoseconds(START + index)))
        bag.write(asked, START + index, START, serialize_message(message))
        bag.write(talk, START + index, START, string(f"word {index}"))
    bag.close()
    events: list[tuple[str, int]] = []
    heard: list[str] = []
    answers = graph.client.node.create_publisher(LimbState, "answered", qos.STATES)

    def answer(message: LimbState) -> None:
        number = stamps.nanoseconds(message.header.stamp) - START
        events.append(("asked", number))
        if events.count(("asked", number)) == 1 and number == 7:
            return  # lost once: it is asked again
        events.append(("answered", number))
        answers.publish(message)

    graph.client.subscribe(LimbState, "asked", qos.STATES, answer)
    graph.client.subscribe(String, "again", qos.STATES, lambda message: heard.append(message.data))
    command = [sys.executable, str(SCRIPTS / "replay_bag.py"), str(tmp_path / "run"), "--rate", "0"]
    command += ["--step-by", "/limb/asked=/limb/answered", "--remap", "/limb/talk=/limb/again"]
    environment = {**os.environ, "ROS_DOMAIN_ID": str(graph.domain_id)}
    with subprocess.Popen([*command, "--wait", "30"], env=environment) as replay:
        graph.client.wait_for(lambda: replay.poll() is not None, 120.0, "the replay")
        assert replay.returncode == 0
    graph.client.wait_for(lambda: len(heard) >= 20, 30.0, "what was not stepped by")
    assert heard == [f"word {index}" for index in range(20)]
    assert [number for what, number in events if what == "answered"] == list(range(20))
    assert events.count(("asked", 7)) == 2
    for before, after in itertools.pairwise(events):
        assert before[0] == "answered" or after[1] == before[1]
