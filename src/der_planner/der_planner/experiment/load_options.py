"""Options by which a command is told how a limb is mounted and what it carries in a run."""

from __future__ import annotations

import argparse
import dataclasses

from der_planner.limb import Limb


def add_load_options(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Add --mounting, --payload and --payload-at."""
    parser.add_argument(
        "--mounting",
        default="",
        help="horizontal, hanging, standing, sideways, or degrees by which a level limb is tilted "
        "about its straight axis, left side up (without it: the gravity of the limb file)",
    )
    parser.add_argument(
        "--payload",
        type=float,
        default=0.0,
        metavar="KG",
        help="mass that the limb carries in the run, beside the masses of its limb file",
    )
    parser.add_argument(
        "--payload-at",
        type=float,
        metavar="M",
        help="where the payload sits, along the limb from its clamp (without it: the tip)",
    )


def as_loaded(limb: Limb, given: argparse.Namespace) -> Limb:
    """Return the limb as it is mounted and loaded in the run.

    Raises:
        LimbError: the mounting is unknown, or the payload is negative or not on the limb.
    """
    mounted = limb.mounted(given.mounting) if given.mounting else limb
    return mounted.carrying(given.payload, given.payload_at)


def without_payload(limb: Limb, given: argparse.Namespace) -> Limb:
    """Return the limb without what only the run carried, which `as_loaded` put on last."""
    return dataclasses.replace(limb, masses=limb.masses[:-1]) if given.payload else limb
