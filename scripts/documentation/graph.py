"""What the running graph says of itself: the parameters and topics of each node, kept as JSON.

python3 scripts/docs.py --graph starts the graph on the twin and writes docs/reference/graph.json; a
test compares that file with the graph.
"""

from __future__ import annotations

import json
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters
from rclpy.parameter import parameter_value_to_python

from der_planner.experiment.client import GraphClient
from der_planner.experiment.console import Progress
from der_planner.experiment.graph_run import running_graph
from der_planner.experiment.processes import GraphError, GraphSetup, NodeProcess
from limb_interfaces import topics
from workspace_setup.basics import ROOT

FILE = ROOT / "docs" / "reference" / "graph.json"
OF_ROS = ("qos_overrides.", "start_type_description_service", "use_sim_time")
"""Beginnings of the names of parameters that every node has."""
BODIES = "pose_tracker"
"""A node that is not part of the experiment on the twin."""
OF_EVERY_NODE = ("/rosout", "/parameter_events")
WHILE_IT_STARTS = ("subscribes", topics.DIAGNOSTICS)
"""Every node looks there for another one of its name; only the page goes on."""
PATIENCE = 20.0
"""Time for which nodes may find each other's topics [s]."""


def text(kept: str) -> str:
    """Start the graph on the twin and return what it says of itself, as JSON.

    Nodes find each other one topic after the other: what differs from the kept text is asked again.
    """
    folder = Path(tempfile.mkdtemp(prefix="graph_"))
    setup = GraphSetup(folder / "bag", {}, planner={}, page=0)
    given = {item.executable: item.parameters for item in setup.nodes("")}
    with GraphClient("reference") as client, running_graph(client, setup, folder, Progress()):
        bodies = NodeProcess("apriltag_tracker", BODIES, {}, folder)
        try:
            end = time.monotonic() + PATIENCE
            said = _said(client, given)
            while said != kept and time.monotonic() < end:
                said = _said(client, given)
            return said
        finally:
            bodies.stop()


def _said(client: GraphClient, given: dict[str, dict[str, Any]]) -> str:
    found = {name: _node(client, name, given.get(name, {})) for name in [*given, BODIES]}
    return json.dumps(found, indent=1, sort_keys=True) + "\n"


def _node(client: GraphClient, name: str, given: dict[str, Any]) -> dict[str, Any]:
    """Return one node's parameters and topics."""
    node, space = client.node, f"/{topics.NAMESPACE}"
    client.wait_for(lambda: name in client.count_nodes(), PATIENCE, f"node {name}")
    ends = {
        "publishes": (
            node.get_publisher_names_and_types_by_node,
            node.get_publishers_info_by_topic,
        ),
        "subscribes": (
            node.get_subscriber_names_and_types_by_node,
            node.get_subscriptions_info_by_topic,
        ),
    }
    found: dict[str, Any] = {"parameters": _parameters(client, name, given)}
    for end, (listed, info) in ends.items():
        # The recorder takes whatever there is.
        pairs = [] if (name, end) == ("recorder", "subscribes") else listed(name, space)
        found[end] = {
            topic.removeprefix(space + "/"): [kinds[0], _quality(info(topic), name)]
            for topic, kinds in pairs
            if topic not in OF_EVERY_NODE and "/_" not in topic
            if name == "page" or (end, topic) != WHILE_IT_STARTS
        }
    services = node.get_service_names_and_types_by_node(name, space)
    found["services"] = {
        service.removeprefix(space + "/"): kinds[0]
        for service, kinds in services
        if not kinds[0].startswith(("rcl_interfaces/", "type_description_interfaces/"))
        and "/_action/" not in service
    }
    return found


def _quality(ends: list[Any], name: str) -> str:
    """Return the quality of service of a node's end of a topic."""
    profile = next(end.qos_profile for end in ends if end.node_name == name)
    words = [profile.reliability.name.lower().replace("_", " ")]
    if profile.durability.name == "TRANSIENT_LOCAL":
        words.append("latched")
    return ", ".join(words)


def _asked(client: GraphClient, kind: Any, service: str, **request: Any) -> Any:
    """Return an answer; one that is lost is asked for again, which does no harm here."""
    for _ in range(9):
        with suppress(GraphError):
            return client.ask(kind, service, timeout=5.0, **request)
    return client.ask(kind, service, **request)


def _parameters(client: GraphClient, name: str, given: dict[str, Any]) -> list[dict[str, Any]]:
    """Return name, default, range and description of each parameter, by their names."""
    listed = _asked(client, ListParameters, f"{name}/list_parameters").result.names
    names = sorted(item for item in listed if not item.startswith(OF_ROS))
    described = _asked(client, DescribeParameters, f"{name}/describe_parameters", names=names)
    values = _asked(client, GetParameters, f"{name}/get_parameters", names=names).values
    found = []
    for item, value in zip(described.descriptors, values, strict=True):
        limits = [*item.floating_point_range, *item.integer_range]
        default = parameter_value_to_python(value)
        if isinstance(default, str) and "/share/" in default:
            default = default.partition("/share/")[2]
        found.append(
            {
                "name": item.name,
                "default": "" if item.name in given else default,
                "range": [limits[0].from_value, limits[0].to_value] if limits else [],
                "description": item.description,
                "choices": item.additional_constraints.removeprefix("one of "),
                "changeable": not item.read_only,
            }
        )
    return found
