"""The orchestrator's view of the graph: readiness and death are told with their cause."""

from __future__ import annotations

import pytest

from der_planner.experiment.processes import GraphError, NodeError

pytestmark = pytest.mark.graph


def test_a_tracker_without_camera_is_named_with_the_cure(graph):
    graph.start("apriltag_tracker", "apriltag_tracker")
    graph.client.wait_for(lambda: "apriltag_tracker" in graph.client.diagnostics, 60, "its word")
    with pytest.raises(GraphError, match=r"'apriltag_tracker' was not ready.*start the camera"):
        graph.client.wait_ready(["apriltag_tracker"], patience=1.0, failing=1.0)


def test_a_driver_without_its_board_ends_with_the_port_and_the_remedy(graph):
    port = str(graph.folder / "no_such_board")
    graph.client.watch([graph.start("pressure_driver", "pressure_driver", port=port)])
    with pytest.raises(NodeError, match=r"'pressure_driver' died \(exit code 1\)") as caught:
        graph.client.wait_ready(["pressure_driver"])
    assert port in str(caught.value)
