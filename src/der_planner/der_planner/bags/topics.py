"""What a bag stores of a topic: the definition of its type, the type's hash, its publishers' QoS.

A bag is read years later on a machine without our packages, so it carries the definition of each of
its types: the text of the ``.msg`` file and of every message inside it, in the layout that rosbag2
calls ``ros2msg``, and the type's hash (RIHS01). The texts, with their comments, come from the
installed share folders; `rosbags` parses and hashes them.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

SEPARATOR = "=" * 80
INFINITE = (9223372036, 854775807)
"""Seconds and nanoseconds that rosbag2 writes for a duration without bound."""
LOG_TOPIC = "/rosout"


class DefinitionError(LookupError):
    """No installed package defines a message type; the message says which and where was looked."""


class Definition(NamedTuple):
    """A message type: its ``ros2msg`` text with all dependencies, and its RIHS01 hash."""

    text: str
    type_hash: str


def installed_prefixes() -> tuple[Path, ...]:
    """Return the prefixes of the sourced workspaces, the overlay first."""
    value = os.environ.get("AMENT_PREFIX_PATH", "")
    return tuple(Path(part) for part in value.split(os.pathsep) if part)


def find_definition(type_name: str) -> Definition:
    """Collect the definition of a message type from the installed share folders.

    Args:
        type_name: ``package/msg/Name``.

    Raises:
        DefinitionError: the type, or one that it contains, is not installed.
    """
    return _find(type_name, installed_prefixes())


def message_class(type_name: str) -> Any:
    """Return the class of a message type of ROS.

    Raises:
        DefinitionError: its package is not installed here.
    """
    try:
        package, _, short = type_name.split("/")
        return getattr(importlib.import_module(f"{package}.msg"), short)
    except (ImportError, AttributeError, ValueError) as error:
        raise DefinitionError(
            f"no class of the message type '{type_name}' ({error}): source the workspace of "
            "its package, or leave its topics out (exclude)"
        ) from error


@cache
def _find(type_name: str, prefixes: tuple[Path, ...]) -> Definition:
    texts: dict[str, str] = {}
    types: dict[str, Any] = {}
    waiting = [type_name]
    while waiting:
        name = waiting.pop()
        if name not in texts:
            texts[name] = _message_file(name, prefixes).read_text(encoding="utf-8").rstrip() + "\n"
            types |= get_types_from_msg(texts[name], name)
            waiting += _contained_types(types[name][1])
    text = texts.pop(type_name)
    for name in sorted(texts):
        package, _, short = name.split("/")
        text += f"{SEPARATOR}\nMSG: {package}/{short}\n{texts[name]}"
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return Definition(text, store.hash_rihs01(type_name))


def _message_file(type_name: str, prefixes: Sequence[Path]) -> Path:
    package, kind, short = [*type_name.split("/"), "", ""][:3]
    if kind == "msg":
        for prefix in prefixes:
            path = prefix / "share" / package / "msg" / f"{short}.msg"
            if path.is_file():
                return path
    looked = ", ".join(str(prefix) for prefix in prefixes) or "nowhere: AMENT_PREFIX_PATH is empty"
    raise DefinitionError(
        f"no definition of the message type '{type_name}' (looked in {looked}): source the "
        "workspace that builds its package before the recorder starts"
    )


def _contained_types(fields: Sequence[tuple[str, Any]]) -> Iterator[str]:
    """Yield the full names of the message types among the fields that `rosbags` parsed."""
    for _, (kind, content) in fields:
        inner, name = content[0] if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) else (kind, content)
        if inner == Nodetype.NAME:
            yield name


@dataclass(frozen=True)
class OfferedQos:
    """The QoS that a publisher offers, by rosbag2's words; durations are infinite."""

    reliability: str = "reliable"
    durability: str = "volatile"
    history: str = "unknown"
    depth: int = 0

    def as_mapping(self) -> dict[str, Any]:
        """Return the profile as version 9 of the metadata writes it."""
        seconds, nanoseconds = INFINITE
        return {
            "history": self.history,
            "depth": self.depth,
            "reliability": self.reliability,
            "durability": self.durability,
            "deadline": {"sec": seconds, "nsec": nanoseconds},
            "lifespan": {"sec": seconds, "nsec": nanoseconds},
            "liveliness": "automatic",
            "liveliness_lease_duration": {"sec": seconds, "nsec": nanoseconds},
            "avoid_ros_namespace_conventions": False,
        }


@dataclass(frozen=True)
class TopicSpec:
    """One recorded topic.

    Attributes:
        name: fully qualified.
        type_name: ``package/msg/Name``.
        definition: text with dependencies, in the encoding ``encoding``.
        type_hash: RIHS01.
        qos: one per publisher seen when the topic was added.
        encoding: of the definition, ``ros2msg`` or ``ros2idl``.
    """

    name: str
    type_name: str
    definition: str
    type_hash: str = ""
    qos: tuple[OfferedQos, ...] = ()
    encoding: str = "ros2msg"

    @classmethod
    def installed(cls, name: str, type_name: str, qos: tuple[OfferedQos, ...] = ()) -> TopicSpec:
        """Return a topic of an installed type.

        Raises:
            DefinitionError: its type is not installed.
        """
        return cls(name, type_name, *find_definition(type_name), qos)

    @property
    def kept(self) -> bool:
        """Whether every publisher keeps its last messages for those who come later."""
        return bool(self.qos) and all(q.durability == "transient_local" for q in self.qos)

    @property
    def latched(self) -> bool:
        """Whether the last message before a recording begins goes into the bag, too.

        ``/rosout`` is kept by its publishers, but an old log line is no state that anyone waits
        for.
        """
        return self.kept and self.name != LOG_TOPIC

    def qos_yaml(self) -> str:
        """Return the offered profiles as the string that MCAP channels carry."""
        profiles = [profile.as_mapping() for profile in self.qos]
        return yaml.safe_dump(profiles, sort_keys=False).strip() if profiles else ""


def parse_qos(text: str) -> tuple[OfferedQos, ...]:
    """Return the profiles of a string that `TopicSpec.qos_yaml`, or rosbag2, wrote."""
    names = ("reliability", "durability", "history", "depth")
    return tuple(
        OfferedQos(*(profile[name] for name in names)) for profile in yaml.safe_load(text or "[]")
    )
