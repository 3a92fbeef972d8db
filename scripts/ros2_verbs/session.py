"""A hidden node that looks at the graph, and the QoS of a command's publisher or subscription."""

from __future__ import annotations

import argparse
import contextlib
import os
import time
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.exceptions import InvalidTopicNameException
from rclpy.qos import DurabilityPolicy, QoSPresetProfiles, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from ros2_verbs.cli import CommandError, EndedBySignal
from ros2_verbs.messages import interface

AT_LEAST = 1.5
"""Shortest time of discovery [s].

The answer to the first announcements of a new participant may stay away; it then sees the others
when these announce themselves again: the nodes of this workspace every 0.5 s, by the profile in
FASTRTPS_DEFAULT_PROFILES_FILE, but others every 3 s.
"""
AT_MOST = 6.0
"""Longest time of discovery [s]."""
QUIET = 0.5
"""Time without anything new that ends discovery [s]."""
QUIET_WHEN_FOUND = 0.2
"""The same [s] once the wanted name is there."""


def is_hidden(name: str) -> bool:
    """Tell whether a name of a topic, service or node is hidden by convention."""
    return any(part.startswith("_") for part in name.split("/") if part)


class Session:
    """A node for the time of one command; a context manager.

    Args:
        options: of the command line; with the ``signals`` that have come, and ``spin_time`` where
            the verb has it.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self._spin_time: float | None = getattr(options, "spin_time", None)
        self._signals: list[int] = options.signals
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node(f"_ros2cli_{os.getpid()}", start_parameter_services=False)

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(Exception):
            self.node.destroy_node()
            rclpy.try_shutdown()

    def spin(self, seconds: float = 0.1) -> None:
        """Take what has come, for at most some time; raise `EndedBySignal` after a signal."""
        rclpy.spin_once(self.node, timeout_sec=seconds)
        if self._signals:
            raise EndedBySignal(self._signals[0])

    def wait(self, condition: Callable[[], Any], timeout: float = float("inf")) -> bool:
        """Spin until a condition holds, at most for a time [s]; tell whether it does."""
        end = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > end:
                return False
            self.spin()
        return True

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
            if quiet >= QUIET_WHEN_FOUND and enough():
                return
            if self._spin_time is not None:
                if elapsed >= self._spin_time:
                    return
            elif elapsed >= AT_MOST or (elapsed >= AT_LEAST and quiet >= QUIET):
                return
            self.spin(0.02)

    def nodes(self) -> list[str]:
        """Return the full name of every node, sorted."""
        found = self.node.get_node_names_and_namespaces()
        return sorted(f"{space.rstrip('/')}/{name}" for name, space in found)

    def topics(self) -> dict[str, list[str]]:
        """Return the types of every topic, sorted by name."""
        return dict(sorted(self.node.get_topic_names_and_types()))

    def services(self) -> dict[str, list[str]]:
        """Return the types of every service, sorted by name."""
        return dict(sorted(self.node.get_service_names_and_types()))

    def find_node(self, name: str) -> str:
        """Discover until a node is there; return its full name.

        Raises:
            CommandError: there is no such node.
        """
        wanted = f"/{name.lstrip('/')}"
        self.discover(lambda: wanted in self.nodes())
        if wanted not in self.nodes():
            raise CommandError("Node not found")
        return wanted

    def expand(self, topic: str) -> str:
        """Return the full name of a topic.

        Raises:
            CommandError: it is not a valid name.
        """
        try:
            return str(self.node.resolve_topic_name(topic))
        except InvalidTopicNameException as error:
            raise CommandError(str(error)) from error

    def topic_type(self, topic: str) -> Any:
        """Return the class of a topic's messages, None if the topic is not there.

        Raises:
            CommandError: the topic has several types, or one that is not installed.
        """
        types = self.topics().get(topic, [])
        if len(types) > 1:
            raise CommandError(f"Topic '{topic}' has more than one type: [{', '.join(types)}]")
        return interface(types[0], "msg") if types else None

    def answer(self, future: Any) -> Any:
        """Wait for the answer to a call.

        Raises:
            CommandError: the answer is an error.
        """
        self.wait(future.done)
        if future.result() is None:
            raise CommandError(f"Exception while calling service: {future.exception()!r}")
        return future.result()

    def call(self, kind: Any, service: str, request: Any) -> Any:
        """Call a service of a node and return the response.

        Raises:
            CommandError: the service does not appear within 5 s, or its answer is an error.
        """
        client = self.node.create_client(kind, service)
        if not self.wait(client.service_is_ready, 5.0):
            raise CommandError("Wait for service timed out")
        return self.answer(client.call_async(request))


def qos_profile(options: argparse.Namespace, preset: str, publishers: list[Any]) -> QoSProfile:
    """Return a QoS profile: as the command line says, else one that hears every publisher.

    Args:
        options: with the ``--qos-…`` arguments.
        preset: name of the profile where the command line names none.
        publishers: endpoint information with ``qos_profile``; empty to publish.
    """
    shared = QoSPresetProfiles.get_from_short_key(options.qos_profile or preset)
    profile = QoSProfile(**{slot[1:]: getattr(shared, slot[1:]) for slot in QoSProfile.__slots__})
    for policy, kind, strong, weak in (
        ("reliability", ReliabilityPolicy, "RELIABLE", "BEST_EFFORT"),
        ("durability", DurabilityPolicy, "TRANSIENT_LOCAL", "VOLATILE"),
    ):
        given = getattr(options, f"qos_{policy}")
        if given is not None:
            setattr(profile, policy, kind[given.upper()])
        elif publishers and options.qos_profile is None:
            strict = all(getattr(each.qos_profile, policy) == kind[strong] for each in publishers)
            setattr(profile, policy, kind[strong if strict else weak])
    if options.qos_depth is not None:
        profile.depth = options.qos_depth
    return profile
