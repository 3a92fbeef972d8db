"""Parts of the ``ros2`` stand-in without a graph: messages, values, QoS, rates."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
sys.path.insert(0, str(SCRIPTS))


def fill(kind, text: str):
    from ros2_verbs.filling import Filler

    return Filler(kind(), yaml.safe_load(text)).message


def test_yaml_is_what_the_real_tool_prints():
    from diagnostic_msgs.msg import DiagnosticArray

    from ros2_verbs.messages import to_yaml

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


def test_yaml_of_special_numbers_and_arrays():
    from geometry_msgs.msg import PoseWithCovariance

    from ros2_verbs.messages import to_csv, to_yaml

    message = fill(PoseWithCovariance, f"{{covariance: [.nan, -.inf, {', '.join(['1.5'] * 34)}]}}")
    lines = to_yaml(message, truncate=3).splitlines()
    assert lines[-5:] == ["covariance:", "- .nan", "- -.inf", "- 1.5", "- '...'"]
    assert "covariance: '<array type: double[36]>'" in to_yaml(message, no_arrays=True)
    assert to_csv(message).startswith("0.0,0.0,0.0,0.0,0.0,0.0,1.0,nan,-inf,1.5,")
    one_line = to_yaml(message.pose.position, flow_style=True)
    assert one_line == "{x: 0.0, y: 0.0, z: 0.0}\n"


def test_yaml_round_trip_of_every_kind_of_field():
    from sensor_msgs.msg import CameraInfo, Image, JointState
    from visualization_msgs.msg import MarkerArray

    from ros2_verbs.messages import to_yaml

    texts = {
        Image: "{height: 1, width: 3, encoding: mono8, is_bigendian: 1, data: [0, 127, 255]}",
        CameraInfo: f"{{d: [0.1, -2.0e-3], k: {[float(i) for i in range(9)]}, "
        "roi: {do_rectify: true}}",
        JointState: "{name: [a, 'ü'], position: [1, .inf]}",
        MarkerArray: "{markers: [{points: [{x: 1.0}, {y: 2.0}], lifetime: {sec: 4}}, {id: -3}]}",
    }
    for kind, text in texts.items():
        message = fill(kind, text)
        assert message != kind()
        assert fill(kind, to_yaml(message)) == message


def test_truncated_and_hidden_strings():
    from std_msgs.msg import String

    from ros2_verbs.messages import to_yaml

    message = String(data="abcdef")
    assert to_yaml(message, truncate=6) == "data: abcdef\n"
    assert to_yaml(message, truncate=5) == "data: abcde...\n"
    assert to_yaml(message, no_strings=True) == "data: '<string length: <6>>'\n"


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ("{positon: {x: 1.0}}", "'Pose' object has no attribute 'positon'"),
        ("{position: {x: wide}}", "'position.x' of type double cannot be 'wide'"),
        ("{position: 3}", "expected to be a dictionary but is a int"),
    ],
)
def test_a_wrong_value_is_refused_by_its_name(values: str, complaint: str):
    from geometry_msgs.msg import Pose

    from ros2_verbs.cli import CommandError

    with pytest.raises(CommandError, match=f"^Failed to populate field: .*{re.escape(complaint)}"):
        fill(Pose, values)


def test_numbers_are_not_rounded_to_fit():
    from geometry_msgs.msg import PoseWithCovariance
    from shape_msgs.msg import SolidPrimitive
    from std_msgs.msg import Byte, Float32, Int32, UInt8MultiArray

    from ros2_verbs.cli import CommandError

    assert fill(Int32, "{data: 2.0}").data == 2
    assert fill(Byte, "{data: 7}").data == b"\x07"
    assert list(fill(UInt8MultiArray, "{data: !!binary AAH/}").data) == [0, 1, 255]
    for kind, text in (
        (Int32, "{data: 1.5}"),
        (Int32, "{data: 3000000000}"),
        (Int32, "{data: true}"),
        (Byte, "{data: 256}"),
        (Float32, "{data: 1.0e+39}"),
        (PoseWithCovariance, "{covariance: [1.0, 2.0]}"),
        (SolidPrimitive, "{dimensions: [1.0, 2.0, 3.0, 4.0]}"),
    ):
        with pytest.raises(CommandError):
            fill(kind, text)
    assert fill(Float32, "{data: -.inf}").data == float("-inf")
    assert fill(Float32, "{data: 1e-3}").data == 1e-3


def test_stamps_are_the_time_of_sending():
    from builtin_interfaces.msg import Time
    from geometry_msgs.msg import PoseStamped
    from std_msgs.msg import Header

    from ros2_verbs.filling import Filler

    for kind, values in ((PoseStamped, {"header": "auto"}), (Header, {"stamp": "now"})):
        filler = Filler(kind(), values)
        for seconds in (5, 6):
            filler.stamp(Time(sec=seconds))
            header = getattr(filler.message, "header", filler.message)
            assert header.stamp.sec == seconds


def test_rate_over_a_window():
    from ros2_verbs.topic_hz import RateMeter

    meter = RateMeter(window=4)
    reports = []
    for count in range(41):
        meter.add(100.0 + 0.1 * count + (0.02 if count == 39 else 0.0))
        if text := meter.report():
            reports.append(text)
    assert (
        reports[0] == "average rate: 10.000\n\tmin: 0.100s max: 0.100s std dev: 0.00000s window: 4"
    )
    assert len(reports) == 3
    meter.add(104.1)
    meter.add(104.2)
    meter.add(105.2)
    # The last four intervals are 0.08, 0.1, 0.1 and 1 s.
    assert meter.report() == (
        "average rate: 3.125\n\tmin: 0.080s max: 1.000s std dev: 0.39268s window: 4"
    )
    meter.add(3.0)  # a clock that was set back
    assert meter.report() is None


def test_qos_hears_every_publisher(capsys: pytest.CaptureFixture[str]):
    from rclpy.qos import QoSProfile

    from ros2_verbs.qos import matching_qos, preset

    def publisher(reliability: str, durability: str) -> SimpleNamespace:
        from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

        profile = QoSProfile(
            depth=1,
            reliability=ReliabilityPolicy[reliability],
            durability=DurabilityPolicy[durability],
        )
        return SimpleNamespace(qos_profile=profile)

    latched = publisher("RELIABLE", "TRANSIENT_LOCAL")
    camera = publisher("BEST_EFFORT", "VOLATILE")
    alike = matching_qos([latched, latched], preset("sensor_data"))
    assert (alike.reliability.name, alike.durability.name) == ("RELIABLE", "TRANSIENT_LOCAL")
    assert capsys.readouterr().out == ""
    mixed = matching_qos([latched, camera], preset("sensor_data"))
    assert (mixed.reliability.name, mixed.durability.name) == ("BEST_EFFORT", "VOLATILE")
    notes = capsys.readouterr().out.splitlines()
    assert [note.split(". Falling")[0].split()[-1] for note in notes] == [
        "QoSReliabilityPolicy.RELIABLE",
        "QoSDurabilityPolicy.TRANSIENT_LOCAL",
    ]
    # The preset itself is shared by the process and must stay as it is.
    assert preset("sensor_data").durability.name == "VOLATILE"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("", None),
        ("--qos-durability transient_local", ("BEST_EFFORT", "TRANSIENT_LOCAL", 5)),
        ("--qos-profile default --qos-depth 3", ("RELIABLE", "VOLATILE", 3)),
        ("--qos-reliability reliable --qos-history keep_all", ("RELIABLE", "VOLATILE", 5)),
    ],
)
def test_qos_of_the_command_line(arguments: str, expected):
    import argparse

    from ros2_verbs.qos import add_qos_arguments, given_qos

    parser = argparse.ArgumentParser()
    add_qos_arguments(parser, "subscribe", "sensor_data")
    profile = given_qos(parser.parse_args(arguments.split()))
    if expected is None:
        assert profile is None
    else:
        assert (profile.reliability.name, profile.durability.name, profile.depth) == expected


def test_interfaces_are_shown_as_their_authors_wrote_them():
    from ros2_verbs.cli import CommandError
    from ros2_verbs.interface import definition

    folder = Path(__file__).resolve().parents[2] / "src" / "der_msgs"
    for kind, name in (("msg", "MotionCommand"), ("action", "PlayMotion")):
        text = (folder / kind / f"{name}.{kind}").read_text()
        assert definition(f"der_msgs/{kind}/{name}") == text
    assert "bool success" in definition("std_srvs/srv/Trigger")
    with pytest.raises(CommandError, match="Unknown interface"):
        definition("der_msgs/msg/Nothing")
    with pytest.raises(CommandError, match="is no interface"):
        definition("MotionCommand")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_python_drops_inside_a_destructor_ends_the_command(number: signal.Signals):
    program = f"""
import os, sys, time
sys.path.insert(0, {str(SCRIPTS)!r})
from ros2_verbs import cli

class Finished:
    def __del__(self):
        os.kill(os.getpid(), {int(number)})
        time.sleep(0)

def work(_):
    Finished()
    while True:
        time.sleep(0.05)

def parser(_):
    options = cli.argparse.ArgumentParser()
    options.set_defaults(main=work, help_of=options)
    return options

cli._parser = parser
sys.exit(cli.main([]))
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False
    )
    assert "Exception ignored in" in done.stderr  # Python has dropped the first one
    assert done.returncode == number, done.stderr
