"""Options by which a command is told how a limb is mounted and what it carries in a run."""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from der_planner.experiment.errors import OptionError
from der_planner.limb import HEAVIEST, Limb, LimbError, gravity_of


class _Once(argparse.Action):
    """Keeps the value of an option that must not be given twice."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,  # noqa: ARG002
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,  # noqa: ARG002
    ) -> None:
        given = f"_given_{self.dest}"
        if hasattr(namespace, given):
            raise argparse.ArgumentError(
                self,
                "given twice; what a limb carries beside one payload goes to its file's masses",
            )
        setattr(namespace, given, True)
        setattr(namespace, self.dest, values)


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
        action=_Once,
        metavar="KG",
        help="mass that the limb carries in the run, beside the masses of its limb file",
    )
    parser.add_argument(
        "--payload-at",
        type=float,
        action=_Once,
        metavar="M",
        help="where the payload sits, along the limb from its clamp (without it: the tip)",
    )


def check_loads(given: argparse.Namespace) -> None:
    """Refuse an unknown mounting, a payload in grams, or the place of a payload that is not there.

    Raises:
        OptionError: names the option and what it may be.
    """
    try:
        if given.mounting:
            gravity_of(given.mounting)
    except LimbError as error:
        raise OptionError(f"--mounting: {error}") from error
    check_kilograms("--payload", given.payload, 0.0)
    if given.payload_at is None:
        return
    if not given.payload:
        raise OptionError("--payload-at is the place of a payload: give --payload, too")
    if not (math.isfinite(given.payload_at) and given.payload_at >= 0):
        raise OptionError(
            f"--payload-at is {given.payload_at} m: choose 0 to the limb's length, from the clamp"
        )


def check_kilograms(name: str, mass: float, least: float) -> None:
    """Refuse a mass [kg] that no limb has or carries.

    Raises:
        OptionError: names the option, and the mass in kg of what may have been given in g.
    """
    if least <= mass <= HEAVIEST:
        return
    grams = f"; {mass:g} g are {mass / 1000:g}" if HEAVIEST < mass <= 1000 * HEAVIEST else ""
    raise OptionError(f"{name} is {mass} kg: choose {least:g} to {HEAVIEST:g}{grams}")


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
