"""The Python half of the contract: parameters and their files, the transport of images."""

import contextlib
import sys

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from domain import own_domain
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from statuses import status

from limb_interfaces import runner
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.parameters import ParameterError, check_overrides, declare, key_matches


@contextlib.contextmanager
def node(*arguments, name="declaring"):
    """Return a node with arguments of a command line, in a domain of this file."""
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=own_domain(__file__))
    line = ["--ros-args", *arguments]
    made = Node(name, context=context, cli_args=line, start_parameter_services=False)
    try:
        yield made
    finally:
        made.destroy_node()
        rclpy.shutdown(context=context)


def declared(given, default, **options):
    """Declare a parameter of a node whose command line gives it; return its value."""
    with node("-p", f"wanted:={given}") as made:
        value = declare(made, "wanted", default, "of a test", **options)
        assert made.get_parameter("wanted").value == value
        return value


def test_a_number_is_taken_where_a_text_or_a_float_is_wanted():
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


def test_what_no_parameter_took_is_said_and_what_is_unknown_is_not_set(tmp_path, monkeypatch):
    file = tmp_path / "of_another_limb.yaml"
    file.write_text("/lab7/declaring:\n  ros__parameters: {wanted: 31}\n")
    with node("-p", "wantde:=1", "--params-file", str(file)) as made:
        declare(made, "wanted", 3, "of a test", read_only=False)
        line = ["declaring", "--ros-args", "--params-file", str(file)]
        monkeypatch.setattr(sys, "argv", line)
        with pytest.raises(ParameterError) as refused:
            check_overrides(made)
        said = str(refused.value)
        assert "'wantde' is set, but /declaring has none: did you mean 'wanted'?" in said
        assert "nothing under /lab7/declaring is for /declaring" in said
        assert made.set_parameters([Parameter("wanted", value=5)])[0].successful
        with pytest.raises(ParameterNotDeclaredException, match="paylod"):
            made.set_parameters([Parameter("paylod", value=5)])


def test_a_second_node_of_a_name_ends_with_the_remedy():
    with node(name="twice") as made:
        publisher = DiagnosticsPublisher(made, Health)
        executor = SingleThreadedExecutor(context=made.context)
        executor.add_node(made)

        told = made.create_publisher(DiagnosticArray, "/diagnostics", 10)
        told.publish(DiagnosticArray(status=[status("/twice", process="lab:1", started="9e99")]))
        assert publisher.publish() == "ok"
        told.publish(DiagnosticArray(status=[status("/twice", process="lab:2", started="17.0")]))
        for _ in range(1000):
            if hasattr(made, "fatal_error"):
                break
            executor.spin_once(timeout_sec=0.05)
        assert "/twice is running already (process lab:2): end it first" in made.fatal_error


@pytest.mark.parametrize(
    ("key", "name", "fits"),
    [
        ("/limb/planner", "/limb/planner", True),
        ("/limb/planner", "/lab2/planner", False),
        ("/**/planner", "/planner", True),
        ("/**", "/a/b/c", True),
        ("/*/planner", "/lab2/planner", True),
        ("/*/planner", "/a/b/planner", False),
    ],
)
def test_keys_of_parameter_files(key, name, fits):
    assert key_matches(key, name) == fits


def test_the_images_transport_is_set_unless_somebody_did(tmp_path, monkeypatch):
    profile = tmp_path / runner.PROFILE
    for name in ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}")
    assert runner.use_large_messages() is None
    profile.parent.mkdir(parents=True)
    profile.write_text("<profiles/>")
    assert runner.use_large_messages() == profile
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "mine.xml")
    assert runner.use_large_messages() is None
