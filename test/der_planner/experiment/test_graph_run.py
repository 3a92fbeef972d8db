"""What the orchestrator says of nodes elsewhere, and how it vents after an error."""

from __future__ import annotations

import contextlib
import os
import sys
from unittest.mock import Mock

import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from der_planner.experiment.console import Progress
from der_planner.experiment.graph_run import PORT_VENTS, RunningGraph
from der_planner.experiment.processes import GraphError, NodeError
from limb_interfaces.clocks import Offset


@pytest.mark.parametrize("error", [GraphError("no answer"), NodeError("the driver died")])
def test_a_driver_that_does_not_vent_is_told_of_and_its_port_is_given_time(error, capsys):
    client, driver = Mock(), Mock()
    client.call.side_effect = error
    RunningGraph(client, Progress(), processes={"pressure_driver": driver}).vent_after_error()
    assert [call.args for call in client.call.call_args_list] == [("pressure_driver/vent",)]
    assert client.watch.call_args_list[0].args == ((driver,),)  # its end is not waited for
    assert [call.args for call in client.spin.call_args_list] == [(PORT_VENTS,)]
    warned = f"may still be under pressure; close its air supply ({error})"
    assert warned in capsys.readouterr().err


def test_a_driver_vents_though_the_terminal_was_closed(monkeypatch):
    far, near = os.pipe()
    os.close(far)
    client = Mock()
    client.call.side_effect = GraphError("no answer")
    with os.fdopen(near, "w", buffering=1) as closed:
        monkeypatch.setattr(sys, "stderr", closed)
        progress = Progress()
        progress.bar(1.0, 2.0, "played")
        driver = Mock(alive=True)
        RunningGraph(client, progress, processes={"pressure_driver": driver}).vent_after_error()
        monkeypatch.undo()
        with contextlib.suppress(BrokenPipeError):
            closed.close()
    assert [call.args for call in client.call.call_args_list] == [("pressure_driver/vent",)]


@pytest.mark.parametrize(
    ("heard", "told"),
    [
        (False, r"was not ready \(apriltag_tracker on camera-pc\).*ROS_DOMAIN_ID.*firewall"),
        (True, r"on camera-pc has other messages \(12345678\).*same version"),
    ],
)
def test_a_node_elsewhere_that_is_missing_or_of_another_version_is_named(heard: bool, told: str):
    client = Mock()
    client.wait_ready.side_effect = None if heard else GraphError("a node was not ready")
    client.diagnostic_values.return_value = {"messages": "12345678"}
    graph = RunningGraph(client, Progress(), elsewhere={"apriltag_tracker": "camera-pc"})
    with pytest.raises(GraphError, match=told):
        graph._wait_elsewhere()


@pytest.mark.parametrize(
    ("message", "said"), [("another clock", True), (Offset(0.045, 0.02).warning, False)]
)
def test_what_a_tracker_warns_of_is_said_before_it_is_played(capsys, tmp_path, message, said):
    # Whose clock is off is said by what is known when the limb is armed.
    warned = DiagnosticStatus(level=DiagnosticStatus.WARN, message=message)
    client = Mock(diagnostics={"apriltag_tracker": warned})
    RunningGraph(client, Progress()).start([], tmp_path, {})
    assert (f"warning: apriltag_tracker: {message}" in capsys.readouterr().err) == said
