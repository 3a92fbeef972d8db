"""A hidden node that looks at the graph, and what every verb asks of it."""

from __future__ import annotations

import argparse
import contextlib
import os
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

import rclpy
from rclpy.expand_topic_name import expand_topic_name
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_full_topic_name import validate_full_topic_name

from ros2_verbs.cli import CommandError, Interruption

HIDDEN_PREFIX = "_"
_AT_LEAST, _AT_MOST = 1.5, 6.0
"""How long discovery lasts [s]. The answer to the first announcements of a new participant may stay
away; it then sees the others when these announce themselves again: the nodes of this workspace
every 0.5 s, by the profile in FASTRTPS_DEFAULT_PROFILES_FILE, but others every 3 s."""
_QUIET, _QUIET_WHEN_FOUND = 0.5, 0.2
"""For how long nothing new must have come [s]."""


def add_session_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of every verb that looks at the graph."""
    parser.add_argument(
        "--spin-time",
        type=float,
        metavar="SPIN_TIME",
        help="Spin time in seconds to wait for discovery (default: until nothing new appears, at "
        "least 1.5; nodes from outside of this workspace may need 4)",
    )
    parser.add_argument(
        "-s", "--use-sim-time", action="store_true", help="Enable ROS simulation time"
    )
    parser.add_argument(
        "--no-daemon", action="store_true", help="Does nothing: there is no daemon here"
    )


def is_hidden(name: str) -> bool:
    """Tell whether a name of a topic, service or node is hidden by convention."""
    return any(part.startswith(HIDDEN_PREFIX) for part in name.split("/") if part)


def absolute(name: str) -> str:
    """Return a node's name with the slash in front."""
    return name if name.startswith("/") else f"/{name}"


class Session:
    """A node for the time of one command; a context manager.

    Args:
        options: with ``spin_time`` and ``use_sim_time``, see `add_session_arguments`.
        name: of the node; hidden and unique if empty.
    """

    def __init__(self, options: argparse.Namespace, name: str = "") -> None:
        self._spin_time: float | None = getattr(options, "spin_time", None)
        # SIGINT and SIGTERM are Python's exceptions here; a context that a signal handler shuts
        # down under a waiting command ends in one of several errors.
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        simulated = getattr(options, "use_sim_time", False)
        self.node = rclpy.create_node(
            name or f"{HIDDEN_PREFIX}ros2cli_{os.getpid()}",
            start_parameter_services=False,
            parameter_overrides=[Parameter("use_sim_time", value=True)] if simulated else [],
        )

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        Interruption.noticed()
        with contextlib.suppress(Exception):
            self.node.destroy_node()
        with contextlib.suppress(Exception):
            rclpy.try_shutdown()

    def discover(self, enough: Callable[[], Any] = lambda: False) -> None:
        """Wait until the graph is known: for the spin time if given, else until it is quiet.

        Args:
            enough: true when that is found for which the caller looks; ends the wait early.
        """
        start = changed = time.monotonic()
        seen = None
        while True:
            picture = (self.nodes(), self.topics(), self.services())
            now = time.monotonic()
            if picture != seen:
                seen, changed = picture, now
            elapsed, quiet = now - start, now - changed
            if quiet >= _QUIET_WHEN_FOUND and enough():
                return
            if self._spin_time is not None:
                if elapsed >= self._spin_time:
                    return
            elif elapsed >= _AT_MOST or (elapsed >= _AT_LEAST and quiet >= _QUIET):
                return
            time.sleep(0.02)

    def nodes(self) -> list[tuple[str, str]]:
        """Return name and namespace of every node, sorted by the full name."""
        found = self.node.get_node_names_and_namespaces()
        return sorted(found, key=lambda item: full_name(*item))

    def topics(self) -> dict[str, list[str]]:
        """Return the types of every topic, sorted by name."""
        return dict(sorted(self.node.get_topic_names_and_types()))

    def services(self) -> dict[str, list[str]]:
        """Return the types of every service, sorted by name."""
        return dict(sorted(self.node.get_service_names_and_types()))

    def expand(self, topic: str) -> str:
        """Return the full name of a topic.

        Raises:
            CommandError: it is not a valid name.
        """
        try:
            expanded: str = expand_topic_name(
                topic, self.node.get_name(), self.node.get_namespace()
            )
            validate_full_topic_name(expanded)
        except Exception as error:
            raise CommandError(str(error)) from error
        return expanded

    def find_node(self, name: str, include_hidden: bool = True) -> bool:
        """Discover until a node is there; tell whether it is."""
        wanted = absolute(name)
        if not include_hidden and wanted.rsplit("/", 1)[-1].startswith(HIDDEN_PREFIX):
            return False
        self.discover(lambda: self._has_node(wanted))
        return self._has_node(wanted)

    def _has_node(self, wanted: str) -> bool:
        return any(full_name(*item) == wanted for item in self.nodes())

    def call(self, kind: Any, service: str, request: Any) -> Any:
        """Call a service of a node and return the response.

        Raises:
            CommandError: the service does not appear within 5 s, or its answer is an error.
        """
        client = self.node.create_client(kind, service)
        if not client.wait_for_service(timeout_sec=5.0):
            raise CommandError("Wait for service timed out")
        return self.answer(client, request)

    def answer(self, client: Any, request: Any) -> Any:
        """Send a request to a service that is there and wait for the response.

        Raises:
            CommandError: the answer is an error.
        """
        future = client.call_async(request)
        while not future.done():
            rclpy.spin_once(self.node, timeout_sec=0.1)
        if future.result() is None:
            raise CommandError(f"Exception while calling service: {future.exception()!r}")
        return future.result()


def print_names(found: dict[str, list[str]], show_types: bool) -> None:
    """Print the names of topics, services or actions a line, with their types if asked for."""
    for name, types in found.items():
        print(f"{name} [{', '.join(types)}]" if show_types else name)


def print_types(
    options: argparse.Namespace, name: str, known: Callable[[Session], dict[str, list[str]]]
) -> int:
    """Print the types of a topic or service; return the exit code, 1 if it is not there.

    Args:
        options: of the session.
        name: of the topic or service.
        known: `Session.topics` or `Session.services`.
    """
    with Session(options) as session:
        session.discover(lambda: name in known(session))
        types = known(session).get(name, [])
    for kind in types:
        print(kind)
    return 0 if types else 1


def full_name(name: str, namespace: str) -> str:
    """Return a node's full name."""
    return f"{namespace}{'' if namespace.endswith('/') else '/'}{name}"
