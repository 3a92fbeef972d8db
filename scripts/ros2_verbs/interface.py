"""``ros2 interface``: the definitions of messages, services and actions."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from ros2_verbs.cli import CommandError, add_verb, add_verbs

KINDS = ("msg", "srv", "action")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb of ``ros2 interface`` and its arguments."""
    verbs = add_verbs(parser, "interface")
    show = add_verb(verbs, "show", "Output the interface definition", _show)
    show.add_argument("type", help="Show an interface definition (e.g. 'std_msgs/msg/String')")


def definition(identifier: str) -> str:
    """Return the text of an interface as its author wrote it; types inside it are not spelt out.

    Raises:
        CommandError: it is no name of an interface, or none is installed under it.
    """
    parts = identifier.split("/")
    if len(parts) != 3 or parts[1] not in KINDS:
        raise CommandError(f"'{identifier}' is no interface: give PACKAGE/{'|'.join(KINDS)}/NAME")
    package, kind, name = parts
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix) / "share" / package / kind / f"{name}.{kind}"
        if prefix and path.is_file():
            return path.read_text()
    raise CommandError(f"Unknown interface '{identifier}'")


def _show(options: argparse.Namespace) -> None:
    print(definition(options.type), end="")
