"""``ros2 topic``: the topics of the graph."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from ros2_verbs import topic_echo, topic_hz, topic_pub
from ros2_verbs.cli import add_verb, add_verbs
from ros2_verbs.session import Session, add_session_arguments, is_hidden, print_names, print_types


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verbs of ``ros2 topic`` and their arguments."""
    verbs = add_verbs(parser, "topic")
    lister = add_verb(verbs, "list", "Output a list of available topics", _list)
    add_session_arguments(lister)
    lister.add_argument(
        "-t", "--show-types", action="store_true", help="Additionally show the topic type"
    )
    lister.add_argument(
        "-c", "--count-topics", action="store_true", help="Only display the number of topics"
    )
    lister.add_argument(
        "-a", "--include-hidden-topics", action="store_true", help="Consider hidden topics as well"
    )
    lister.add_argument(
        "-v", "--verbose", action="store_true", help="List full details about each topic"
    )
    info = add_verb(verbs, "info", "Print information about a topic", _info)
    add_session_arguments(info)
    info.add_argument("topic_name", help="Name of the ROS topic to get info (e.g. '/chatter')")
    info.add_argument(
        "-v", "--verbose", action="store_true", help="Prints the endpoints with their QoS"
    )
    kind = add_verb(verbs, "type", "Print a topic's type", _type)
    add_session_arguments(kind)
    kind.add_argument("topic_name", help="Name of the ROS topic to get type (e.g. '/chatter')")
    topic_echo.add_arguments(verbs)
    topic_hz.add_arguments(verbs)
    topic_pub.add_arguments(verbs)


def _list(options: argparse.Namespace) -> None:
    with Session(options) as session:
        session.discover()
        found = {
            name: types
            for name, types in session.topics().items()
            if options.include_hidden_topics or not is_hidden(name)
        }
        if options.count_topics:
            print(len(found))
        elif options.verbose:
            _print_ends("Published", "publisher", found, session.node.count_publishers)
            _print_ends("Subscribed", "subscriber", found, session.node.count_subscribers)
        else:
            print_names(found, options.show_types)


def _print_ends(
    title: str, noun: str, topics: dict[str, list[str]], count: Callable[[str], int]
) -> None:
    print(f"{title} topics:")
    for name, types in topics.items():
        number = count(name)
        if number:
            plural = "s" if number > 1 else ""
            print(f" * {name} [{', '.join(types)}] {number} {noun}{plural}")
    print()


def _info(options: argparse.Namespace) -> str | None:
    name = options.topic_name
    end = "\n\n" if options.verbose else "\n"
    with Session(options) as session:
        session.discover()
        types = session.topics().get(name)
        if types is None:
            return f"Unknown topic '{name}'"
        node = session.node
        print(f"Type: {types[0] if len(types) == 1 else types}", end=end)
        print(f"Publisher count: {node.count_publishers(name)}", end=end)
        for endpoint in node.get_publishers_info_by_topic(name) if options.verbose else []:
            print(endpoint, end=end)
        print(f"Subscription count: {node.count_subscribers(name)}", end=end)
        for endpoint in node.get_subscriptions_info_by_topic(name) if options.verbose else []:
            print(endpoint, end=end)
    return None


def _type(options: argparse.Namespace) -> int:
    return print_types(options, options.topic_name, Session.topics)
