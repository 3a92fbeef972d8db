"""The stand-in for the ``ros2`` command: its parts, and as processes against a node in this one."""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import re
import signal
import subprocess
import sys
import threading
import time
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import rclpy
import yaml
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from domain import own_domain
from geometry_msgs.msg import Pose, PoseStamped, PoseWithCovariance
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.action import ActionServer, CancelResponse
from rclpy.context import Context
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, JointState
from shape_msgs.msg import SolidPrimitive
from std_msgs.msg import Byte, Float32, Float64MultiArray, Header, Int32, String
from std_srvs.srv import SetBool
from visualization_msgs.msg import MarkerArray
from waiting import wait_for

from der_msgs.action import PlayMotion
from ros2_verbs import cli
from ros2_verbs.cli import CommandError
from ros2_verbs.messages import Filled, to_yaml
from ros2_verbs.session import qos_profile
from ros2_verbs.verbs import RateMeter

ROOT = Path(__file__).resolve().parents[2]
COMMAND = ROOT / "scripts" / "ros2"
DOMAIN = own_domain(__file__)
TIMEOUT = 120.0
ENVIRONMENT = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN)}
PLAY = "der_msgs/action/PlayMotion"


def fill(kind, text: str):
    return Filled(kind, text).message


def test_yaml_is_what_the_real_tool_prints():
    message = fill(
        DiagnosticArray,
        "{header: {stamp: {sec: 3, nanosec: 5}}, "
        "status: [{name: pump, level: 2, values: [{key: state, value: idle}]}]}",
    )
    assert to_yaml(message) == (
        "header:\n  stamp:\n    sec: 3\n    nanosec: 5\n  frame_id: ''\n"
        "status:\n- level: \"\\x02\"\n  name: pump\n  message: ''\n  hardware_id: ''\n"
        "  values:\n  - key: state\n    value: idle\n"
    )
    assert to_yaml(message.status[0], shown=3, arrays=False).endswith(
        "name: pum...\nmessage: ''\nhardware_id: ''\n"
        "values: '<sequence<diagnostic_msgs/KeyValue>, length: 1>'\n"
    )


def test_a_message_of_every_kind_of_field_survives_yaml():
    texts = {
        Image: "{height: 1, width: 3, encoding: mono8, is_bigendian: 1, data: [0, 127, 255]}",
        CameraInfo: f"{{d: [0.1, -2.0e-3], k: {[float(i) for i in range(9)]}, "
        "roi: {do_rectify: true}}",
        JointState: "{name: [a, 'ü'], position: [1, .inf]}",
        MarkerArray: "{markers: [{points: [{x: 1.0}, {y: 2.0}], lifetime: {sec: 4}}, {id: -3}]}",
        PoseWithCovariance: f"{{covariance: [-.inf, 1e-3, {', '.join(['1.5'] * 34)}]}}",
    }
    for kind, text in texts.items():
        message = fill(kind, text)
        assert message != kind()
        assert fill(kind, to_yaml(message)) == message


def test_a_wrong_value_is_refused_by_its_field_and_not_rounded():
    for kind, text, complaint in (
        (Pose, "{positon: {x: 1.0}}", "Pose has no 'positon'"),
        (Pose, "{position: {x: wide}}", "'position.x' of type double cannot be 'wide'"),
        (Pose, "{position: 3}", "'position' takes a dictionary"),
        (Int32, "{data: 1.5}", "'data' of type int32 cannot be 1.5"),
        (Byte, "{data: 256}", "'data'"),
        (Float32, "{data: 1.0e+39}", "'data'"),
        (PoseWithCovariance, "{covariance: [1.0, 2.0]}", "'covariance'"),
        (SolidPrimitive, "{dimensions: [1.0, 2.0, 3.0, 4.0]}", "'dimensions'"),
    ):
        with pytest.raises(CommandError, match=re.escape(complaint)):
            fill(kind, text)
    assert fill(Byte, "{data: 7}").data == b"\x07"


def test_stamps_are_the_time_of_sending():
    for kind, text in ((PoseStamped, "{header: auto}"), (Header, "{stamp: now}")):
        filled = Filled(kind, text)
        for seconds in (5, 6):
            filled.stamp(Time(sec=seconds))
            assert getattr(filled.message, "header", filled.message).stamp.sec == seconds


def test_rate_over_a_window():
    meter = RateMeter(window=4)
    reports = [meter.add(100.0 + 0.1 * count) for count in range(38)]
    steady = "average rate: 10.000\n\tmin: 0.100s max: 0.100s std dev: 0.00000s window: 4"
    assert [text for text in reports if text] == [steady] * 3
    # The last four intervals are 0.1, 0.1, 0.1 and 1 s.
    assert meter.add(104.7) == (
        "average rate: 3.077\n\tmin: 0.100s max: 1.000s std dev: 0.38971s window: 4"
    )


def test_qos_hears_every_publisher_unless_the_command_line_says_more():
    latched, camera = (
        SimpleNamespace(qos_profile=QoSProfile(depth=1, reliability=which, durability=kept))
        for which, kept in (
            (ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL),
            (ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE),
        )
    )
    nothing = {f"qos_{key}": None for key in ("profile", "depth", "reliability", "durability")}
    given = {"qos_profile": "default", "qos_durability": "transient_local", "qos_depth": 3}
    for publishers, options, policies in (
        ([latched, latched], {}, ("RELIABLE", "TRANSIENT_LOCAL", 5)),
        ([latched, camera], {}, ("BEST_EFFORT", "VOLATILE", 5)),
        ([camera], given, ("RELIABLE", "TRANSIENT_LOCAL", 3)),
    ):
        found = qos_profile(Namespace(**nothing | options), "sensor_data", publishers)
        assert (found.reliability.name, found.durability.name, found.depth) == policies


def ros2(*arguments: str) -> SimpleNamespace:
    """Run the command in this process; returns exit code, stdout and stderr."""

    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    out, complaint = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(complaint):
            result = cli.main(arguments)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if isinstance(result, str):  # what `sys.exit` would say
        return SimpleNamespace(returncode=1, stdout=out.getvalue(), stderr=f"{result}\n")
    return SimpleNamespace(
        returncode=result or 0, stdout=out.getvalue(), stderr=complaint.getvalue()
    )


def start(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [COMMAND, *arguments],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=ENVIRONMENT,
    )  # fmt: skip


def test_run_becomes_the_executable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    index = tmp_path / "share/ament_index/resource_index/packages"
    index.mkdir(parents=True)
    (index / "demo").touch()
    executable = tmp_path / "lib/demo/node"
    executable.parent.mkdir(parents=True)
    executable.write_text('#!/bin/sh\necho "$$ $*"\nread line\n')
    executable.chmod(0o755)
    monkeypatch.setitem(ENVIRONMENT, "AMENT_PREFIX_PATH", str(tmp_path))
    process = start("run", "demo", "node", "--ros-args", "-p", "a:=1", "-h")
    try:
        # The same process, so that signals to it reach the node.
        assert process.stdout.readline() == f"{process.pid} --ros-args -p a:=1 -h\n"
        process.terminate()
        assert process.wait(TIMEOUT) == -signal.SIGTERM
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ("run nowhere node", "Package 'nowhere' not found"),
        ("run der_planner nothing", "No executable found"),
        ("service call /s std_srvs/srv/Nothing", "The passed service type is invalid"),
    ],
)
def test_what_cannot_be_done_is_said(arguments: str, complaint: str):
    result = ros2(*arguments.split())
    assert result.returncode == 1
    assert complaint in result.stderr


def test_a_wrong_argument_is_refused_from_outside_of_the_workspace(tmp_path: Path):
    result = subprocess.run(
        [Path(sys.base_prefix) / "bin" / "python3", COMMAND, "topic", "hz", "/t", "--window", "0"],
        env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
        cwd=tmp_path, capture_output=True, text=True, timeout=TIMEOUT, check=False,
    )  # fmt: skip
    assert (result.returncode, "Traceback" in result.stderr) == (2, False)
    assert "value must be positive" in result.stderr


class Talker:
    """A node with latched and quick topics, parameters, a service and an action, in threads."""

    def __init__(self) -> None:
        self.heard: list[str] = []
        self.cancelled = False
        self._playing = threading.Lock()
        self._context = Context()
        rclpy.init(context=self._context, domain_id=DOMAIN)
        self.node = node = rclpy.create_node("talker", namespace="limb", context=self._context)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._latched = node.create_publisher(String, "latched", latched)
        self._latched.publish(String(data="kept for those who come later"))
        self._array = node.create_publisher(Float64MultiArray, "array", qos_profile_sensor_data)
        node.create_timer(0.05, lambda: self._array.publish(Float64MultiArray(data=[0.5] * 200)))
        node.create_subscription(String, "heard", lambda m: self.heard.append(m.data), 10)
        limits = FloatingPointRange(from_value=0.0, to_value=10.0)
        node.declare_parameter(
            "gain", 1.5, ParameterDescriptor(description="of it", floating_point_range=[limits])
        )
        node.declare_parameter("names", ["a", "b"])
        node.create_service(SetBool, "switch", self._switch)
        ActionServer(
            node, PlayMotion, "play", self._play, cancel_callback=lambda _: CancelResponse.ACCEPT
        )
        self._executor = MultiThreadedExecutor(3, context=self._context)
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    @staticmethod
    def _switch(request, response):
        response.success = request.data
        response.message = "switched"
        return response

    def _play(self, goal):
        """Carry out a goal, which takes half a second; ``endless`` waits to be cancelled."""
        motion = goal.request.command.motion
        last = 3000 if motion == "endless" else 25
        with self._playing:
            # More than once: the first feedback may be sent before the client's reader is known.
            for count in itertools.count(1):
                goal.publish_feedback(PlayMotion.Feedback(state="streaming", progress=0.5))
                time.sleep(0.02)
                if goal.is_cancel_requested or count == last:
                    break
            if goal.is_cancel_requested:
                self.cancelled = True
                goal.canceled()
            else:
                goal.succeed()
        return PlayMotion.Result(plan_id=motion, tip_error=0.25)

    def close(self) -> None:
        with self._playing:
            self._executor.shutdown()
        self._thread.join(5.0)
        self.node.destroy_node()
        self._context.try_shutdown()


@pytest.fixture(scope="module")
def talker() -> Iterator[Talker]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
        running = Talker()
        yield running
        running.close()


@pytest.mark.graph
def test_topics_are_listed_with_their_types(talker: Talker):
    lines = ros2("topic", "list", "-t").stdout.splitlines()
    assert "/limb/heard [std_msgs/msg/String]" in lines
    assert not any("_ros2cli" in line for line in lines)


@pytest.mark.graph
def test_echo(talker: Talker):
    latched = ros2("topic", "echo", "--once", "/limb/latched")
    assert (latched.returncode, latched.stdout) == (0, "data: kept for those who come later\n---\n")
    array = ros2("topic", "echo", "limb/array", "std_msgs/Float64MultiArray", "--once")
    document = next(yaml.safe_load_all(array.stdout))
    assert document["data"] == [0.5] * 128 + ["..."]
    field = ros2("topic", "echo", "/limb/array", "--once", "--field", "layout.data_offset")
    assert field.stdout == "0\n---\n"
    wrong = ros2("topic", "echo", "/limb/array", "--once", "--field", "layout.dims")
    assert (wrong.returncode, wrong.stderr) == (1, "Invalid field 'layout.dims'\n")


@pytest.mark.graph
def test_hz_until_a_signal_comes(talker: Talker):
    process = start("topic", "hz", "/limb/array", "--window", "10")
    try:
        lines = [process.stdout.readline(), process.stdout.readline()]
        process.send_signal(signal.SIGINT)
        assert process.wait(TIMEOUT) == signal.SIGINT
    finally:
        process.kill()
        process.communicate()
    assert re.fullmatch(r"average rate: \d+\.\d{3}\n", lines[0])
    pattern = r"\tmin: \d+\.\d{3}s max: \d+\.\d{3}s std dev: \d+\.\d{5}s window: \d+\n"
    assert re.fullmatch(pattern, lines[1])


@pytest.mark.graph
def test_pub(talker: Talker):
    result = ros2(
        *["topic", "pub", "-t", "3", "-r", "20", "limb/heard", "std_msgs/String"], "data: go"
    )
    assert result.returncode == 0
    published = result.stdout[result.stdout.index("publisher:") :]
    line = "std_msgs.msg.String(data='go')\n\n"
    expected = "".join(f"publishing #{count}: {line}" for count in (1, 2, 3))
    assert published == f"publisher: beginning loop\n{expected}"
    wait_for(lambda: len(talker.heard) >= 3, "what was published", TIMEOUT)
    assert talker.heard == ["go"] * 3


@pytest.mark.graph
def test_parameters(talker: Talker):
    node = "/limb/talker"
    assert "  gain\n  names\n" in ros2("param", "list", node).stdout
    assert ros2("param", "get", node, "names").stdout == "String values are: ['a', 'b']\n"
    changed = ros2("param", "set", node, "gain", "2.5")
    assert (changed.returncode, changed.stdout) == (0, "Set parameter successful\n")
    assert ros2("param", "get", node, "gain").stdout == "Double value is: 2.5\n"
    refused = ros2("param", "set", node, "gain", "25.0")
    assert refused.stderr.startswith("Setting parameter failed: ")
    assert talker.node.get_parameter("gain").value == 2.5
    described = ros2("param", "describe", node, "gain").stdout
    assert "  Description: of it\n  Constraints:\n    Min value: 0.0\n" in described
    missing = ros2("param", "get", node, "nothing")
    assert (missing.returncode, missing.stderr) == (1, "Parameter not set\n")


@pytest.mark.graph
def test_service_call(talker: Talker):
    result = ros2("service", "call", "/limb/switch", "std_srvs/srv/SetBool", "{data: true}")
    assert result.returncode == 0
    assert result.stdout[result.stdout.index("requester:") :] == (
        "requester: making request: std_srvs.srv.SetBool_Request(data=True)\n\n"
        "response:\nstd_srvs.srv.SetBool_Response(success=True, message='switched')\n\n"
    )


@pytest.mark.graph
def test_a_goal_is_sent_and_its_feedback_and_result_shown(talker: Talker):
    answer = ros2("action", "send_goal", "-f", "/limb/play", PLAY, "{command: {motion: star}}")
    assert answer.returncode == 0, answer.stderr
    for text in ("state: streaming", "plan_id: star", "tip_error: 0.25", "status: SUCCEEDED"):
        assert text in answer.stdout, answer.stdout


@pytest.mark.graph
def test_ctrl_c_cancels_the_goal(talker: Talker):
    goal = "{command: {motion: endless}}"
    process = start("action", "send_goal", "-f", "/limb/play", PLAY, goal)
    while "streaming" not in (line := process.stdout.readline()):
        assert line, process.communicate()
    process.send_signal(signal.SIGINT)
    said, complaint = process.communicate(timeout=60)
    assert talker.cancelled, complaint
    assert "status: CANCELED" in said
    assert process.returncode == 1
