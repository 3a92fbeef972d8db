"""Message definitions of any type on the graph, as a bag embeds them.

A bag is read years later on a machine without our packages, so it carries the definition of each of
its types: the text of the ``.msg`` file and of every message inside it, in the layout that rosbag2
calls ``ros2msg``, and the type's hash (RIHS01). Both come from the installed share folders, which
hold them for apt's ROS as for its wheels and for the packages of this workspace.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

SEPARATOR = "=" * 80
_PRIMITIVES = frozenset(
    (
        *("bool", "byte", "char", "float32", "float64", "string", "wstring"),
        *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
    )
)
_FIELD = re.compile(r"^\s*([A-Za-z][A-Za-z0-9_/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[A-Za-z]")
_PARTS = 3


class DefinitionError(LookupError):
    """No installed package defines a message type; the message says which and where was looked."""


@dataclass(frozen=True)
class MessageDefinition:
    """What a bag stores about one type.

    Attributes:
        name: full name, e.g. ``der_msgs/msg/LimbState``.
        text: definition with all dependencies, encoding ``ros2msg``.
        type_hash: RIHS01 hash; empty where the installation has none.
    """

    name: str
    text: str
    type_hash: str


def installed_prefixes() -> tuple[Path, ...]:
    """Return the prefixes of the sourced workspaces, the overlay first."""
    value = os.environ.get("AMENT_PREFIX_PATH", "")
    return tuple(Path(part) for part in value.split(os.pathsep) if part)


def find_definition(type_name: str, prefixes: Sequence[Path] | None = None) -> MessageDefinition:
    """Collect the definition of a message type from the installed share folders.

    Args:
        type_name: ``package/msg/Name``.
        prefixes: where to look, first hit wins; the sourced workspaces if None.

    Raises:
        DefinitionError: the type, or one that it contains, is not installed.
    """
    return _find(type_name, tuple(installed_prefixes() if prefixes is None else prefixes))


@cache
def _find(type_name: str, prefixes: tuple[Path, ...]) -> MessageDefinition:
    done: dict[str, str] = {}
    waiting = [type_name]
    while waiting:
        name = waiting.pop(0)
        if name in done:
            continue
        path = _message_file(name, prefixes)
        done[name] = path.read_text(encoding="utf-8")
        waiting += _contained_types(done[name], package=name.split("/")[0])
    parts = [done.pop(type_name).rstrip("\n")]
    for name in sorted(done):
        package, _, short = name.split("/")
        parts.append(f"{SEPARATOR}\nMSG: {package}/{short}\n{done[name].rstrip(chr(10))}")
    text = "\n".join(parts) + "\n"
    return MessageDefinition(type_name, text, _type_hash(type_name, prefixes))


def _message_file(type_name: str, prefixes: Sequence[Path]) -> Path:
    parts = type_name.split("/")
    if len(parts) == _PARTS and parts[1] == "msg":
        for prefix in prefixes:
            path = prefix / "share" / parts[0] / "msg" / f"{parts[2]}.msg"
            if path.is_file():
                return path
    looked = ", ".join(str(prefix) for prefix in prefixes) or "nowhere: AMENT_PREFIX_PATH is empty"
    raise DefinitionError(
        f"no definition of the message type '{type_name}' (looked in {looked}): source the "
        "workspace that builds its package before the recorder starts"
    )


def _contained_types(text: str, package: str) -> list[str]:
    """List the full names of the message types that fields of a ``.msg`` text have."""
    found: list[str] = []
    for line in text.splitlines():
        match = _FIELD.match(line.split("#")[0])
        if match is None or match.group(1) in _PRIMITIVES:
            continue
        parts = match.group(1).split("/")
        if parts == ["Header"]:
            parts = ["std_msgs", "Header"]
        owner = package if len(parts) == 1 else parts[0]
        found.append(f"{owner}/msg/{parts[-1]}")
    return found


def _type_hash(type_name: str, prefixes: Sequence[Path]) -> str:
    package, _, short = type_name.split("/")
    for prefix in prefixes:
        path = prefix / "share" / package / "msg" / f"{short}.json"
        if path.is_file():
            hashes = json.loads(path.read_text(encoding="utf-8")).get("type_hashes", [])
            return next((h["hash_string"] for h in hashes if h["type_name"] == type_name), "")
    return ""
