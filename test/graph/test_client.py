"""The orchestrator's view of the graph: readiness and death are told with their cause."""

from __future__ import annotations

import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from der_planner.experiment.processes import GraphError, NodeError

pytestmark = pytest.mark.graph


def test_a_node_that_is_not_ready_is_named_with_what_it_says(graph):
    silent = DiagnosticStatus(level=DiagnosticStatus.STALE, message="start the camera")
    graph.client.diagnostics["apriltag_tracker"] = silent
    with pytest.raises(GraphError, match=r"'apriltag_tracker' was not ready.*start the camera"):
        graph.client.wait_ready(["apriltag_tracker"], patience=0.1)


def test_a_driver_without_its_board_ends_with_the_port_and_the_remedy(graph):
    port = str(graph.folder / "no_such_board")
    graph.client.watch([graph.start("pressure_driver", "pressure_driver", port=port)])
    with pytest.raises(NodeError, match=r"'pressure_driver' died \(exit code 1\)") as caught:
        graph.client.wait_ready(["pressure_driver"])
    assert port in str(caught.value)
