from __future__ import annotations

import copy

import numpy as np
import pytest
import yaml

from apriltag_tracker.tag_map import MapError, TagMap, WorldTag


@pytest.fixture
def content(config):
    return yaml.safe_load((config / "tags.yaml").read_text())


def test_corners_of_a_turned_tag():
    tag = WorldTag(1, (1.0, 2.0, 0.1), np.pi / 2, 0.2)
    expected = [(1.1, 1.9, 0.1), (1.1, 2.1, 0.1), (0.9, 2.1, 0.1), (0.9, 1.9, 0.1)]
    assert np.allclose(tag.corners(), expected)


def _set(*path, value):
    def change(content):
        place = content
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("schema", value=9), "schema"),
        (_set("family", value="tagCustom48h12"), "tagCustom48h12.*tag36h11, tag36h10"),
        (_set("family", value="tag16h5"), "none of 0 to 29, which tag16h5 has"),
        (_set("limb", "segment_lengths", value=[0.1, -0.1]), "segment_lengths"),
        (_set("limb", "tags", value=[]), "at least one"),
        (_set("limb", "tags", 0, "id", value=700), "700"),
        (_set("limb", "tags", 1, "id", value=True), "id True"),
        (_set("limb", "tags", 0, "hight", value=0.03), "limb tag 0: unknown key 'hight'"),
        (_set("world", "tags", 0, "yaaw", value=1.0), "world tag 100: unknown key 'yaaw'"),
        (_set("world", "tags", value=[]), "world.tags is empty"),
        (_set("limb", "tags", 0, "arc_length", value=0.5), "arc_length 0.5"),
        (_set("limb", "tags", 0, "size", value=0.0), "size"),
        (_set("limb", "tags", 0, "offset", value=[0.0]), "offset"),
        (_set("limb", "tags", 0, "id", value=100), "twice"),
        (_set("limb", "stiff", value=[[0.1, 0.05]]), "stiff"),
        (_set("limb", "stiff", value=[[0.0, 0.1]]), "more than half"),
        (_set("world", "tags", 0, "yaw", value=float("nan")), "yaw"),
    ],
)
def test_impossible_maps_are_refused_by_name(content, change, message):
    content = copy.deepcopy(content)
    change(content)
    with pytest.raises(MapError, match=message):
        TagMap.from_dict(content)


def test_files_are_named(tmp_path):
    with pytest.raises(MapError, match="nowhere"):
        TagMap.from_yaml(tmp_path / "nowhere.yaml")
    path = tmp_path / "tags.yaml"
    path.write_text("[1, 2")
    with pytest.raises(MapError, match="not YAML"):
        TagMap.from_yaml(path)
    path.write_text("schema: 1  # é", encoding="latin-1")
    with pytest.raises(MapError, match=r"tags\.yaml.*utf-8"):
        TagMap.from_yaml(path)
    path.write_text("schema: 2")
    with pytest.raises(MapError, match=r"tags\.yaml.*schema"):
        TagMap.from_yaml(path)
