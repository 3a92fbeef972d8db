"""Definitions of installed messages against rosbags' own knowledge of them."""

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from der_planner.bags.topics import DefinitionError, find_definition, installed_prefixes


@pytest.mark.parametrize(
    "name",
    ["visualization_msgs/msg/MarkerArray", "sensor_msgs/msg/CameraInfo", "rcl_interfaces/msg/Log"],
)
def test_standard_types_parse_to_what_rosbags_ships(name):
    shipped = get_typestore(Stores.ROS2_JAZZY)
    definition = find_definition(name)
    parsed = get_types_from_msg(definition.text, name)
    for key, (_, fields) in parsed.items():
        assert fields == shipped.fielddefs[key][1], key
    assert definition.type_hash == shipped.hash_rihs01(name)


def test_every_message_of_ours_is_complete_and_hashes_right():
    folder = next(
        prefix / "share/der_msgs/msg"
        for prefix in installed_prefixes()
        if (prefix / "share/der_msgs/msg").is_dir()
    )
    names = [f"der_msgs/msg/{path.stem}" for path in folder.glob("*.msg")]
    assert len(names) >= 9
    for name in names:
        definition = find_definition(name)
        types = get_typestore(Stores.EMPTY)
        types.register(get_types_from_msg(definition.text, name))
        assert types.hash_rihs01(name) == definition.type_hash


@pytest.mark.parametrize("name", ["no_msgs/msg/None", "std_srvs/srv/Trigger", "nonsense"])
def test_unknown_type_is_named_with_a_remedy(name):
    with pytest.raises(DefinitionError, match=f"'{name}'.*source the workspace"):
        find_definition(name)
