"""The recorder as a process of the graph, and replays as people start them."""

import itertools
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from bags import START, TEXT, read_texts, spec, string
from rclpy.duration import Duration
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image
from std_msgs.msg import Header, String, UInt8MultiArray

from der_planner.bags.reader import BagReader
from der_planner.bags.writer import BagWriter
from der_planner.experiment.processes import GraphError, NodeError
from limb_interfaces import qos

pytestmark = pytest.mark.graph
SCRIPTS = Path(__file__).resolve().parents[3] / "scripts"


def record(graph, **parameters):
    """Start a recorder, and wait until it is ready."""
    process = graph.start("der_planner", "recorder", output=str(graph.folder / "run"), **parameters)
    graph.client.watch([process])
    graph.client.wait_ready(["recorder"])
    return process


def talk(graph, topic: str, profile=qos.STATES, kind=String):
    """Return a publisher that the recorder has found."""
    publisher = graph.client.node.create_publisher(kind, topic, profile)
    graph.client.wait_for(publisher.get_subscription_count, 60.0, f"a subscriber of {topic}")
    return publisher


def test_records_the_graph_between_start_and_stop(graph, tmp_path: Path):
    record(graph, metadata='{"motion": "circle", "trial": 3}')
    call, node = graph.client.call, graph.client.node
    latched = talk(graph, "latched", qos.LATCHED)
    latched.publish(String(data="the plan"))
    fast = talk(graph, "fast", qos.SENSOR_DATA)
    image = node.create_publisher(Image, "camera/image_raw", qos.SENSOR_DATA)
    node.create_publisher(String, "moves/_action/feedback", 1)
    fast.publish(String(data="before the start"))
    with pytest.raises(GraphError, match="not recording"):
        call("recorder/stop")

    assert call("recorder/start") == str(tmp_path / "run")
    with pytest.raises(GraphError, match="already recording"):
        call("recorder/start")
    for index in range(20):
        fast.publish(String(data=f"fast {index}"))
        image.publish(Image(data=b"123"))
    late = talk(graph, "late")  # appears while recording
    for word in ("late one", "late two"):
        late.publish(String(data=word))
    assert late.wait_for_all_acked(Duration(seconds=30))
    assert call("recorder/stop") == str(tmp_path / "run")
    with pytest.raises(GraphError, match="not empty: name another"):
        call("recorder/start")

    texts = read_texts(tmp_path / "run")
    assert texts[0] == "the plan"
    assert [t for t in texts if t.startswith("fast")] == [f"fast {i}" for i in range(20)]
    assert [t for t in texts if "late" in t] == ["late one", "late two"]
    assert "before the start" not in texts
    with BagReader(tmp_path / "run") as bag:
        assert bag.run() == {"motion": "circle", "trial": 3}
        assert "/limb/camera/image_raw" not in bag.topics
        assert "/limb/moves/_action/feedback" not in bag.topics
        assert "/limb/clock/questions" not in bag.topics
        assert "/diagnostics" in bag.topics
        assert bag.topics["/limb/latched"].latched
        assert not bag.topics["/limb/fast"].reliable


def test_the_end_of_the_node_closes_the_bag(graph, tmp_path: Path):
    process = record(graph, autostart=True, topics="/limb/talk")
    publisher = talk(graph, "talk")
    for index in range(20):
        publisher.publish(String(data=f"word {index}"))
    assert publisher.wait_for_all_acked(Duration(seconds=30))
    assert process.stop() == 0
    assert read_texts(tmp_path / "run") == [f"word {index}" for index in range(20)]


def test_what_a_stopped_recorder_missed_is_counted(graph, tmp_path: Path):
    process, told = record(graph, topics="/limb/data"), graph.client.diagnostic_values
    data = talk(graph, "data", 10, UInt8MultiArray)
    graph.client.call("recorder/start")
    data.publish(UInt8MultiArray(data=bytes(1000)))
    graph.client.wait_for(lambda: told("recorder").get("recorded") == "1", 60.0, "the first one")
    process.signal(signal.SIGSTOP)
    for _ in range(1000):
        data.publish(UInt8MultiArray(data=bytes(1000)))
    process.signal(signal.SIGCONT)
    assert data.wait_for_all_acked(Duration(seconds=30))
    graph.client.call("recorder/stop")
    with BagReader(tmp_path / "run") as bag:
        missed = 1001 - bag.topics["/limb/data"].message_count
    assert missed > 0
    said = f"/limb/data: {missed}"
    graph.client.wait_for(lambda: told("recorder")["missed"] == said, 30.0, said)


def test_a_bag_that_cannot_be_written_is_reported_at_once(graph, tmp_path: Path):
    record(graph, autostart=True, topics="/limb/talk")
    shutil.rmtree(tmp_path / "run")
    told = graph.client.diagnostic_values
    graph.client.wait_for(lambda: told("recorder").get("state") == "failed", 60.0, "the failure")
    assert "was removed" in graph.client.diagnostics["recorder"].message
    (tmp_path / "run").write_text("a file is in the way")
    with pytest.raises(GraphError, match="cannot write a bag into"):
        graph.client.call("recorder/start")


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"topics": "(["}, r"parameter 'topics' is '\(\['"),
        ({"compression": "rar"}, "parameter 'compression'"),
        ({"metadata": "{broken", "autostart": True}, "parameter 'metadata' is no JSON"),
    ],
)
def test_bad_parameters_are_refused_by_name(graph, parameters, message):
    with pytest.raises(NodeError, match=message):
        record(graph, **parameters)


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
