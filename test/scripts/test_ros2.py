"""The stand-in for the ``ros2`` command, against a node in this process and as processes."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from domain import own_domain

ROOT = Path(__file__).resolve().parents[2]
COMMAND = ROOT / "scripts" / "ros2"
DOMAIN = own_domain(__file__)
TIMEOUT = 120.0
# Where the real tool is installed, the stand-in is tested all the same.
ENVIRONMENT = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN), "DER_LIMB_ROS2_HANDED_OVER": "1"}


def ros2(*arguments: str, **environment: str):
    """Run the command to its end; returns exit code, stdout and stderr."""
    return subprocess.run(
        [COMMAND, *arguments],
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
        check=False,
        env={**ENVIRONMENT, **environment},
    )


def start(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [COMMAND, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
    )


# The graph.


class Talker:
    """A node with a topic of each QoS, parameters and services, spinning in a thread."""

    def __init__(self) -> None:
        import rclpy
        from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
        from std_msgs.msg import Float64MultiArray, String
        from std_srvs.srv import SetBool

        self.heard: list[str] = []
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
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(node)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    @staticmethod
    def _switch(request, response):
        response.success = request.data
        response.message = "switched"
        return response

    def _spin(self) -> None:
        while not self._stop.is_set():
            self._executor.spin_once(timeout_sec=0.1)

    def close(self) -> None:
        import rclpy

        self._stop.set()
        self._thread.join()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)


@pytest.fixture(scope="module")
def talker() -> Iterator[Talker]:
    running = Talker()
    yield running
    running.close()


def listed(wanted: str, *arguments: str) -> list[str]:
    """Return the lines of a list as soon as it has a wanted one: discovery takes its time."""
    deadline = time.monotonic() + TIMEOUT
    while time.monotonic() < deadline:
        result = ros2(*arguments, "--spin-time", "1")
        assert result.returncode == 0, result.stderr
        if wanted in result.stdout.splitlines():
            break
    return result.stdout.splitlines()


@pytest.mark.graph
def test_lists(talker: Talker):
    topics = listed("/limb/heard [std_msgs/msg/String]", "topic", "list", "-t")
    assert not any("_ros2cli" in topic for topic in topics)
    # Without a time, long enough to see everything.
    assert ros2("node", "list").stdout.splitlines().count("/limb/talker") == 1
    services = listed("/limb/switch [std_srvs/srv/SetBool]", "service", "list", "--show-types")
    assert not any("_ros2cli" in service for service in services)
    assert "/limb/switch [std_srvs/srv/SetBool]" in services
    info = ros2("node", "info", "/limb/talker").stdout
    assert info.startswith("/limb/talker\n  Subscribers:\n    /limb/heard: std_msgs/msg/String\n")
    assert info.endswith("  Action Servers:\n\n  Action Clients:\n\n")


@pytest.mark.graph
def test_echo(talker: Talker):
    latched = ros2("topic", "echo", "--once", "/limb/latched")
    assert (latched.returncode, latched.stdout) == (0, "data: kept for those who come later\n---\n")
    array = ros2("topic", "echo", "limb/array", "std_msgs/Float64MultiArray", "--once")
    document = next(yaml.safe_load_all(array.stdout))
    assert document["data"] == [0.5] * 128 + ["..."]
    field = ros2("topic", "echo", "/limb/array", "--once", "--full-length", "--field", "data")
    assert field.stdout == f"array('d', {[0.5] * 200})\n---\n"
    wrong = ros2("topic", "echo", "/limb/array", "--once", "--field", "layout.dims")
    assert wrong.returncode == 1
    assert "Invalid field 'layout.dims'" in wrong.stderr


@pytest.mark.graph
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_hz(talker: Talker, number: signal.Signals):
    process = start("topic", "hz", "/limb/array", "--window", "10")
    try:
        lines = [process.stdout.readline()]
        if lines[0].startswith("WARNING"):
            lines = [process.stdout.readline()]
        lines.append(process.stdout.readline())
        process.send_signal(number)
        assert process.wait(TIMEOUT) == number
    finally:
        process.kill()
        process.communicate()
    assert re.fullmatch(r"average rate: \d+\.\d{3}\n", lines[0])
    pattern = r"\tmin: \d+\.\d{3}s max: \d+\.\d{3}s std dev: \d+\.\d{5}s window: \d+\n"
    assert re.fullmatch(pattern, lines[1])


@pytest.mark.graph
def test_pub(talker: Talker):
    talker.heard.clear()
    result = ros2(
        "topic", "pub", "-t", "3", "-r", "20", "limb/heard", "std_msgs/String", "data: go"
    )
    assert result.returncode == 0
    published = result.stdout[result.stdout.index("publisher:") :]
    line = "std_msgs.msg.String(data='go')\n\n"
    expected = "".join(f"publishing #{count}: {line}" for count in (1, 2, 3))
    assert published == f"publisher: beginning loop\n{expected}"
    deadline = time.monotonic() + TIMEOUT
    while len(talker.heard) < 3 and time.monotonic() < deadline:
        time.sleep(0.05)
    assert talker.heard == ["go"] * 3


@pytest.mark.graph
def test_parameters(talker: Talker):
    node = "/limb/talker"
    assert "  gain\n  names\n" in ros2("param", "list", node).stdout
    assert ros2("param", "get", node, "gain").stdout == "Double value is: 1.5\n"
    assert ros2("param", "get", node, "names").stdout == "String values are: ['a', 'b']\n"
    changed = ros2("param", "set", node, "gain", "2.5")
    assert (changed.returncode, changed.stdout) == (0, "Set parameter successful\n")
    assert talker.node.get_parameter("gain").value == 2.5
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
@pytest.mark.parametrize(
    ("arguments", "code", "complaint"),
    [
        ("run nowhere node", 1, "Package 'nowhere' not found"),
        ("run der_planner nothing", 1, "No executable found"),
        (
            "topic echo /nowhere --spin-time 0",
            1,
            "Could not determine the type for the passed topic",
        ),
        ("topic info /nowhere --spin-time 0", 1, "Unknown topic '/nowhere'"),
        ("node info /nowhere --spin-time 0", 1, "Unable to find node '/nowhere'"),
        ("param get /nowhere gain --spin-time 0", 1, "Node not found"),
        ("topic pub --once /t std_msgs/msg/Nothing", 1, "The passed message type is invalid"),
        ("service call /s std_srvs/srv/Nothing", 1, "The passed service type is invalid"),
        ("service call /s std_srvs/srv/SetBool {on:1}", 1, "Failed to populate field: "),
        ("topic pub --once /t std_msgs/msg/String hello", 1, "needs to be a dictionary in YAML"),
        ("topic hz /t --window 0", 2, "value must be a positive integer"),
        ("bag record", 2, "invalid choice: 'bag'"),
    ],
)
def test_what_cannot_be_done(arguments: str, code: int, complaint: str):
    result = ros2(*arguments.split())
    assert result.returncode == code
    assert complaint in result.stderr
    assert "Traceback" not in result.stderr


# Executables, and the way into the workspace.


@pytest.fixture
def prefix(tmp_path: Path) -> Path:
    """Return an install prefix with a package ``demo`` and its executable ``node``."""
    index = tmp_path / "share/ament_index/resource_index/packages"
    index.mkdir(parents=True)
    (index / "demo").touch()
    executable = tmp_path / "lib/demo/node"
    executable.parent.mkdir(parents=True)
    executable.write_text('#!/bin/sh\necho "$$ $*"\nread line\n')
    executable.chmod(0o755)
    return tmp_path


def test_run_becomes_the_executable(prefix: Path):
    process = subprocess.Popen(
        [COMMAND, "run", "demo", "node", "--ros-args", "-p", "a:=1", "-h"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**ENVIRONMENT, "AMENT_PREFIX_PATH": str(prefix)},
    )
    try:
        # The same process, so that signals to it reach the node.
        assert process.stdout.readline() == f"{process.pid} --ros-args -p a:=1 -h\n"
        process.terminate()
        assert process.wait(TIMEOUT) == -signal.SIGTERM
    finally:
        process.kill()
        process.communicate()


def test_run_names_executables_that_exist_twice(prefix: Path):
    second = prefix / "lib/demo/other/node"
    second.parent.mkdir()
    second.write_text("#!/bin/sh\n")
    second.chmod(0o755)
    result = ros2("run", "demo", "node", AMENT_PREFIX_PATH=str(prefix))
    assert result.returncode == 1
    assert result.stderr.splitlines()[0] == "Multiple executables found:"
    assert {f"- {second}", f"- {prefix / 'lib/demo/node'}"} <= set(result.stderr.splitlines())


@pytest.mark.parametrize("works", [True, False])
def test_hands_over_to_a_real_tool_that_works(
    tmp_path: Path, works: bool, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.delitem(ENVIRONMENT, "DER_LIMB_ROS2_HANDED_OVER")
    real = tmp_path / "ros2"
    real.write_text(f'#!/bin/sh\necho "real $* $DER_LIMB_WORKSPACE"\nexit {0 if works else 1}\n')
    real.chmod(0o755)
    result = ros2("run", "nowhere", "node", PATH=f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    if works:
        assert result.stdout == f"real run nowhere node {ROOT}\n"
    else:
        assert (result.returncode, result.stdout) == (1, "")
        assert result.stderr == "Package 'nowhere' not found\n"


def test_enters_the_workspace_by_itself(tmp_path: Path):
    outside = SimpleNamespace(
        python=Path(sys.base_prefix) / "bin" / f"python3.{sys.version_info.minor}",
        environment={
            "PATH": "/usr/bin:/bin",
            "HOME": str(tmp_path),
            "DER_LIMB_ROS2_HANDED_OVER": "1",
        },
    )
    result = subprocess.run(
        [outside.python, COMMAND, "service", "call", "/s", "der_msgs/srv/Nothing"],
        env=outside.environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
        check=False,
    )
    assert result.returncode == 1
    assert result.stderr.splitlines()[-1] == "The passed service type is invalid"
