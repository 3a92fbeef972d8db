"""Small bags for tests, written with rosbags' own serializer so that two codes must agree."""

from __future__ import annotations

from pathlib import Path

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from der_planner.bags.topics import OfferedQos, TopicSpec, find_definition

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def store():
    """Return a type store that knows der_msgs by the definitions that bags embed."""
    types = get_typestore(Stores.ROS2_JAZZY)
    for name in (
        "LimbState",
        "PressurePlan",
        "PressureSetpoint",
        "PressureState",
        "ChamberPressures",
    ):
        full = f"der_msgs/msg/{name}"
        found = get_types_from_msg(find_definition(full).text, full)
        types.register({key: value for key, value in found.items() if key not in types.types})
    return types


def spec(name: str, type_name: str, latched: bool = False) -> TopicSpec:
    """Return a topic with one publisher."""
    durability = "transient_local" if latched else "volatile"
    return TopicSpec.installed(name, type_name, (OfferedQos(durability=durability),))


def string(text: str) -> bytes:
    """Return the CDR of a std_msgs/String."""
    types = get_typestore(Stores.ROS2_JAZZY)
    message = types.types["std_msgs/msg/String"](data=text)
    return bytes(types.serialize_cdr(message, "std_msgs/msg/String"))


TEXT = "std_msgs/msg/String"


def read_texts(path: Path) -> list[str]:
    """Read every String of a bag with rosbags alone."""
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        return [
            reader.deserialize(data, connection.msgtype).data
            for connection, _, data in reader.messages()
            if connection.msgtype == TEXT
        ]
