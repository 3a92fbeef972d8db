"""``ros2 node``: the nodes of the graph."""

from __future__ import annotations

import argparse
import sys

from rclpy.action.graph import (
    get_action_client_names_and_types_by_node,
    get_action_server_names_and_types_by_node,
)

from ros2_verbs.cli import add_verb, add_verbs
from ros2_verbs.session import (
    HIDDEN_PREFIX,
    Session,
    absolute,
    add_session_arguments,
    full_name,
    is_hidden,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verbs of ``ros2 node`` and their arguments."""
    verbs = add_verbs(parser, "node")
    lister = add_verb(verbs, "list", "Output a list of available nodes", _list)
    add_session_arguments(lister)
    lister.add_argument("-a", "--all", action="store_true", help="Display all nodes even hidden")
    lister.add_argument(
        "-c", "--count-nodes", action="store_true", help="Only display the number of nodes"
    )
    info = add_verb(verbs, "info", "Output information about a node", _info)
    add_session_arguments(info)
    info.add_argument("node_name", help="Fully qualified node name to request information")
    info.add_argument(
        "--include-hidden",
        action="store_true",
        help="Display hidden topics, services, and actions as well",
    )


def _list(options: argparse.Namespace) -> None:
    with Session(options) as session:
        session.discover()
        names = [
            full_name(name, space)
            for name, space in session.nodes()
            if options.all or not name.startswith(HIDDEN_PREFIX)
        ]
    if options.count_nodes:
        print(len(names))
        return
    if len(set(names)) < len(names):
        print(
            "WARNING: Be aware that there are nodes in the graph that share an exact name, "
            "which can have unintended side effects.",
            file=sys.stderr,
        )
    for name in names:
        print(name)


def _info(options: argparse.Namespace) -> str | None:
    with Session(options) as session:
        wanted = absolute(options.node_name)
        if not session.find_node(wanted, include_hidden=options.include_hidden):
            return f"Unable to find node '{options.node_name}'"
        # The endpoints of a node come a moment after its name: until there are no more.
        session.discover(lambda: True)
        same = sum(full_name(*item) == wanted for item in session.nodes())
        if same > 1:
            print(
                f'There are {same} nodes in the graph with the exact name "{wanted}". '
                "You are seeing information about only one of them.",
                file=sys.stderr,
            )
        space, name = wanted.rsplit("/", 1)
        node, who = session.node, (name, space or "/")
        parts = {
            "Subscribers": node.get_subscriber_names_and_types_by_node(*who),
            "Publishers": node.get_publisher_names_and_types_by_node(*who),
            "Service Servers": node.get_service_names_and_types_by_node(*who),
            "Service Clients": node.get_client_names_and_types_by_node(*who),
            "Action Servers": get_action_server_names_and_types_by_node(node, *who),
            "Action Clients": get_action_client_names_and_types_by_node(node, *who),
        }
        print(wanted)
        for title, found in parts.items():
            print(f"  {title}:")
            shown = [item for item in found if options.include_hidden or not is_hidden(item[0])]
            # Like the real tool, one empty line where there is nothing.
            print("\n".join(f"    {name}: {', '.join(types)}" for name, types in shown))
    return None
