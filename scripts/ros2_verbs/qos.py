"""QoS of a command's publisher or subscription: from the command line, or from the publishers."""

from __future__ import annotations

import argparse
from typing import Any

from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSPresetProfiles,
    QoSProfile,
    QoSReliabilityPolicy,
)


def add_qos_arguments(parser: argparse.ArgumentParser, does: str, profile: str) -> None:
    """Declare the ``--qos-…`` arguments.

    Args:
        parser: of a verb.
        does: "subscribe" or "publish", for the help.
        profile: name of the profile where none is given.
    """
    parser.set_defaults(default_profile=profile)
    parser.add_argument(
        "--qos-profile",
        choices=QoSPresetProfiles.short_keys(),
        help=f"Quality of service preset profile to {does} with (default: {profile})",
    )
    parser.add_argument(
        "--qos-depth", metavar="N", type=int, help=f"Queue size setting to {does} with"
    )
    for name, policy in (
        ("history", QoSHistoryPolicy),
        ("reliability", QoSReliabilityPolicy),
        ("durability", QoSDurabilityPolicy),
    ):
        parser.add_argument(
            f"--qos-{name}",
            choices=policy.short_keys(),
            help=f"Quality of service {name} setting to {does} with (overrides the profile's)",
        )


def given_qos(options: argparse.Namespace) -> QoSProfile | None:
    """Return the profile of the command line, None if it says nothing about QoS."""
    said = (
        options.qos_profile,
        options.qos_depth,
        options.qos_history,
        options.qos_reliability,
        options.qos_durability,
    )
    if all(item is None for item in said):
        return None
    profile = preset(options.qos_profile or options.default_profile)
    if options.qos_history is not None:
        profile.history = QoSHistoryPolicy.get_from_short_key(options.qos_history)
    if options.qos_reliability is not None:
        profile.reliability = QoSReliabilityPolicy.get_from_short_key(options.qos_reliability)
    if options.qos_durability is not None:
        profile.durability = QoSDurabilityPolicy.get_from_short_key(options.qos_durability)
    if options.qos_depth is not None and options.qos_depth >= 0:
        profile.depth = options.qos_depth
    elif profile.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL and profile.depth == 0:
        profile.depth = 1
    return profile


def preset(name: str) -> QoSProfile:
    """Return a copy of a preset profile, which the caller may change."""
    shared = QoSPresetProfiles.get_from_short_key(name)
    return QoSProfile(**{slot[1:]: getattr(shared, slot[1:]) for slot in QoSProfile.__slots__})


def matching_qos(publishers: list[Any], profile: QoSProfile) -> QoSProfile:
    """Return a profile that hears every one of the publishers.

    Args:
        publishers: endpoint information with ``qos_profile``.
        profile: what is used where there is no publisher; changed.
    """
    wishes = (
        ("reliability", QoSReliabilityPolicy.RELIABLE, QoSReliabilityPolicy.BEST_EFFORT),
        ("durability", QoSDurabilityPolicy.TRANSIENT_LOCAL, QoSDurabilityPolicy.VOLATILE),
    )
    for policy, strong, weak in wishes if publishers else ():
        strict = [getattr(item.qos_profile, policy) == strong for item in publishers]
        if any(strict) and not all(strict):
            owner = type(strong).__name__.removeprefix("QoS")
            print(
                f"Some, but not all, publishers are offering QoS{owner}.{strong.name}. "
                f"Falling back to QoS{owner}.{weak.name} as it will connect to all publishers"
            )
        setattr(profile, policy, strong if all(strict) else weak)
    return profile
