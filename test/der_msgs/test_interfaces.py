"""The Python half of the contract: gaps in stamps, parameter files, the transport of images."""

import platform
import subprocess
import sys

import numpy as np
import pytest
from domain import own_domain

from limb_interfaces import transport
from limb_interfaces.gaps import StampGaps
from limb_interfaces.overrides import key_matches, node_keys, parameter_files

PERIOD = 33_333_333


def declared(given, default, **options):
    """Declare a parameter of a node whose command line gives it; return its value."""
    import rclpy
    from rclpy.node import Node

    from limb_interfaces.parameters import declare

    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=own_domain(__file__))
    line = ["--ros-args", "-p", f"wanted:={given}"]
    node = Node("declaring", context=context, cli_args=line, start_parameter_services=False)
    try:
        value = declare(node, "wanted", default, "of a test", **options)
        assert node.get_parameter("wanted").value == value
        return value
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


def test_a_number_is_taken_where_a_text_or_a_float_is_wanted():
    from limb_interfaces.parameters import ParameterError

    assert declared("10", "") == "10"
    assert declared("7.5", "") == "7.5"
    mass = declared("0", 0.5, at_least=0.0, at_most=10.0)
    assert (mass, type(mass)) == (0.0, float)
    for given, default, options in (
        ("20", 0.5, {"at_most": 10.0}),
        ("yes", 0.5, {}),
        ("true", "", {}),
        ("1.5", 3, {}),
    ):
        with pytest.raises(ParameterError, match="parameter 'wanted'"):
            declared(given, default, **options)


def missed(stamps, **options):
    gaps = StampGaps(**options)
    for stamp in stamps:
        gaps.take(int(stamp))
    return gaps.missed


@pytest.mark.parametrize("kept", [1.0, 0.5, 0.25])
def test_missed_messages_are_counted_however_many_are_lost(kept):
    random = np.random.default_rng(7)
    sent = 10**15 + PERIOD * np.arange(3000) + random.normal(0.0, 1e6, 3000).round()
    arrived = sent[random.random(3000) < kept]
    inside = round((arrived[-1] - arrived[0]) / PERIOD) + 1
    assert missed(arrived) == pytest.approx(inside - len(arrived), rel=0.03, abs=0)


def test_pauses_replays_and_messages_without_stamp_are_no_gaps():
    stream = [10**15 + index * PERIOD for index in range(50)]
    later = [stamp + 60 * 10**9 for stamp in stream]
    assert missed([*stream, *later, *stream, 0, 0]) == 0


@pytest.mark.parametrize(
    ("key", "name", "fits"),
    [
        ("/limb/planner", "/limb/planner", True),
        ("/limb/planner", "/lab2/planner", False),
        ("/**/planner", "/lab2/planner", True),
        ("/**/planner", "/planner", True),
        ("/**", "/a/b/c", True),
        ("/*/planner", "/lab2/planner", True),
        ("/*/planner", "/a/b/planner", False),
        ("/planner", "/limb/planner", False),
    ],
)
def test_keys_of_parameter_files(key, name, fits):
    assert key_matches(key, name) == fits


def test_nodes_of_a_parameter_file_and_files_of_a_command_line():
    content = {
        "/limb": {"planner": {"ros__parameters": {"a": 1}}},
        "recorder": {"ros__parameters": {}},
    }
    assert list(node_keys(content)) == ["/limb/planner", "/recorder"]
    line = ["node", "--ros-args", "--params-file", "a.yaml", "-p", "b:=1", "--params-file", "c"]
    assert parameter_files(line) == ["a.yaml", "c"]


def test_the_images_transport_is_set_unless_somebody_did(tmp_path, monkeypatch):
    profile = tmp_path / transport.PROFILE
    for name in ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}")
    assert transport.use_large_messages() is None
    profile.parent.mkdir(parents=True)
    profile.write_text("<profiles/>")
    assert transport.use_large_messages() == profile
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "mine.xml")
    assert transport.use_large_messages() is None


_RECEIVE = """
import resource, sys
from limb_interfaces import transport
if "keep" in sys.argv:
    assert transport.keep_buffers()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(50):
    copies = [bytearray(1 << 20) for _ in range(4)]
    del copies
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="a setting of the GNU C library")
def test_the_memory_of_an_image_is_kept_for_the_next_one():
    """A process of its own: pages of 4 MiB that are faulted anew with each of 50 images, or not."""
    faults = [
        int(subprocess.check_output([sys.executable, "-c", _RECEIVE, how], text=True))
        for how in ("give", "keep")
    ]
    assert faults[1] < 3000
    assert faults[0] > 5 * faults[1]
