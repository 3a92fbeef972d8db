"""Small bags for tests, written with rosbags' own serializer so that two codes must agree."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from der_planner.bags.topics import OfferedQos, TopicSpec, find_definition

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
TEXT = "std_msgs/msg/String"
STANDARD = get_typestore(Stores.ROS2_JAZZY)


def store(*names: str):
    """Return a type store that knows these types, too, by the definitions that bags embed."""
    types = get_typestore(Stores.ROS2_JAZZY)
    for name in names:
        found = get_types_from_msg(find_definition(name).text, name)
        types.register({key: value for key, value in found.items() if key not in types.types})
    return types


def message(types, name: str, **fields):
    """Return a message whose other fields are zero, false or empty."""
    made = {
        field: fields.pop(field) if field in fields else _zero(types, *what)
        for field, what in types.fielddefs[name][1]
    }
    assert not fields, f"{name} has no {fields}"
    return types.types[name](**made)


def _zero(types, kind, content):
    if kind == Nodetype.NAME:
        return message(types, content)
    if kind == Nodetype.BASE:
        return "" if content[0] == "string" else np.dtype(content[0]).type().item()
    (inner, base), size = content
    many = inner == Nodetype.BASE and base[0] != "string"
    return np.zeros(size if kind == Nodetype.ARRAY else 0, base[0]) if many else []


def spec(name: str, type_name: str, latched: bool = False) -> TopicSpec:
    """Return a topic with one publisher."""
    durability = "transient_local" if latched else "volatile"
    return TopicSpec.installed(name, type_name, (OfferedQos(durability=durability),))


def string(text: str) -> bytes:
    """Return the CDR of a std_msgs/String."""
    return bytes(STANDARD.serialize_cdr(message(STANDARD, TEXT, data=text), TEXT))


def read_texts(path: Path) -> list[str]:
    """Read every String of a bag with rosbags alone."""
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        return [
            reader.deserialize(data, connection.msgtype).data
            for connection, _, data in reader.messages()
            if connection.msgtype == TEXT
        ]
