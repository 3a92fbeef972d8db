"""What the commands share on a terminal: steps and bars, one interrupt, options of loads."""

from __future__ import annotations

import argparse
import dataclasses
import math
import signal
import sys
import time
from collections.abc import Sequence
from types import FrameType
from typing import Any

from der_planner.limb import HEAVIEST, Limb, LimbError, gravity_of


class OptionError(ValueError):
    """The command line or the hardware file asks for something impossible; says what and why."""


class Progress:
    """Prints steps to stderr; redraws a bar on a terminal, prints it rarely elsewhere."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._last_shown = -1e9
        self._open_line = False

    def say(self, text: str) -> None:
        """Print one line."""
        self._end_bar()
        print(text, file=sys.stderr, flush=True)

    def bar(self, done: float, total: float, text: str, unit: str = "s") -> None:
        """Show that ``done`` of ``total`` seconds, or of another unit, are over."""
        now = time.monotonic()
        finished = done >= total
        if now - self._last_shown < (0.2 if self._terminal else 15.0) and not finished:
            return
        self._last_shown = -1e9 if finished else now
        share = min(max(done / total, 0.0), 1.0) if total > 0 else 1.0
        line = f"  [{'#' * int(30 * share):<30}] {max(done, 0.0):5.0f} / {total:.0f} {unit} {text}"
        if self._terminal:
            print(f"\r{line:<100}", end="", file=sys.stderr, flush=True)
            self._open_line = True
            if finished:
                self._end_bar()
        else:
            print(line, file=sys.stderr, flush=True)

    def _end_bar(self) -> None:
        if self._open_line:
            print(file=sys.stderr)
            self._open_line = False


def interrupt_once() -> None:
    """Turn the first signal that ends a run into a KeyboardInterrupt with its name.

    The signals are `limb_interfaces.entry.END_SIGNALS`; later ones are ignored, so that they do not
    cut the venting short.
    """
    # Without ROS there is nothing to vent, and this package is not there.
    from limb_interfaces.entry import on_end_signals  # noqa: PLC0415

    def interrupt(number: int, _frame: FrameType | None) -> None:
        on_end_signals(signal.SIG_IGN)
        raise KeyboardInterrupt(signal.Signals(number).name)

    on_end_signals(interrupt)


# Loads -------------------------------------------------------------------------------------------


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
