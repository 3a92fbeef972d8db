"""What the graph says of itself: to the orchestrator, and for the site."""

from __future__ import annotations

import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from der_planner.experiment.processes import GraphError, NodeError
from documentation import graph

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


def test_the_kept_reference_is_what_the_graph_says(monkeypatch, request):
    from domain import own_domain

    monkeypatch.setenv("ROS_DOMAIN_ID", str(own_domain(request.path)))
    kept = graph.FILE.read_text()
    assert graph.text(kept) == kept, "run python3 scripts/docs.py --graph"
