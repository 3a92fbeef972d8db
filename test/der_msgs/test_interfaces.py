"""The Python half of the contract: parameters and their files, clocks, the transport of images."""

import contextlib
import math
import sys

import numpy as np
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
from limb_interfaces.clocks import LARGEST, Offset, OffsetEstimate
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
        told.publish(DiagnosticArray(status=[status("motor", started="at noon")]))  # of another lab
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


SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def exchange(estimate, true_time, error, way, back):
    """Ask at this time of the driver's clock [ns]; return the node's clock when the answer came.

    Args:
        error: of the node's clock [ns] at a time of the driver's.
        way, back: [ns] that question and answer take.
    """
    received, answered = true_time + way, true_time + way + 20_000
    returned = answered + back
    now = returned + error(returned)
    estimate.add(true_time + error(true_time), received, answered, now)
    return now


@pytest.mark.parametrize("seed", range(4))
def test_a_clock_that_is_off_and_runs_fast_is_told_within_its_uncertainty(seed):
    """30 ms behind and 50 ppm fast; one way in ten is held up by up to 40 ms."""
    generator = np.random.default_rng(seed)
    estimate = OffsetEstimate()

    def error(time):
        return -30_000_000 + round(50e-6 * (time - START))

    for second in range(200):
        ways = generator.exponential(300_000.0, 2) + 100_000.0
        ways += (generator.random(2) < 0.1) * generator.uniform(0.0, 40e6, 2)
        true_time = START + second * SECOND
        now = exchange(estimate, true_time, error, *map(round, ways))
        offset = estimate.at(now)
        truth = -1e-9 * error(true_time)
        assert abs(offset.seconds - truth) <= offset.uncertainty + 1e-6
    assert offset.uncertainty < 1.5e-3
    assert "behind the driver's" in offset.warning
    assert "chrony" in offset.warning
    assert offset.too_far


def test_a_clock_that_was_set_is_noticed_with_the_next_answer():
    estimate = OffsetEstimate()
    for second in range(10):
        exchange(estimate, START + second * SECOND, lambda _: 0, 200_000, 200_000)
    now = exchange(estimate, START + 10 * SECOND, lambda _: 5_000_000, 300_000, 300_000)
    offset = estimate.at(now)
    assert offset.seconds == pytest.approx(-5e-3, abs=1e-6)
    assert "5.0 ms ahead of the driver's" in offset.warning
    assert not offset.too_far


def test_what_is_not_sure_is_no_reason_to_warn():
    assert Offset(8e-3, 9e-3).warning == ""
    assert Offset(0.9e-3, 1e-4).warning == ""
    assert Offset(math.nan, math.inf).warning == ""
    assert not Offset(2.0 * LARGEST, 3.0 * LARGEST).too_far


def test_an_answer_from_before_its_question_tells_nothing():
    estimate = OffsetEstimate()
    estimate.add(START, START + 50, START + 60, START - SECOND)
    assert math.isnan(estimate.at(START).seconds)
