"""What the site says of nodes, topics and parameters is what the running graph says."""

import pytest

from documentation import graph

pytestmark = pytest.mark.graph


def test_the_kept_reference_is_what_the_graph_says(monkeypatch, request):
    from domain import own_domain

    monkeypatch.setenv("ROS_DOMAIN_ID", str(own_domain(request.path)))
    kept = graph.FILE.read_text()
    assert graph.text(kept) == kept, "run python3 scripts/docs.py --graph"
