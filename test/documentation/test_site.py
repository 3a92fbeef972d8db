"""The site of docs/ is built without a complaint; each topic is described."""

import importlib
import json
import re

import pytest

from documentation import build, reference
from figures import graph
from limb_interfaces import topics
from workspace_setup.basics import ROOT

LAYOUTS = ROOT / "src" / "der_planner" / "config"


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_and_its_tutorials_run():
    assert build.build() == 0


def test_each_topic_has_a_text():
    names = {value for name, value in vars(topics).items() if name.isupper()}
    assert dict(reference.topic_texts()).keys() == names - {topics.NAMESPACE, topics.BASE_FRAME}


def test_the_drawing_of_the_graph_has_topics_at_their_ends():
    nodes = json.loads(reference.GRAPH.read_text())
    arrows = re.findall(r'(\w+) -- "(.+)" --> (\w+)', graph.text())
    assert len(arrows) >= 8
    for source, label, target in arrows:
        named = set(label.split(", "))
        assert source == "you" or named <= nodes[source]["publishes"].keys()
        assert named <= nodes[target]["subscribes"].keys()
    assert graph.mark() in graph.DRAWING.read_text(), "python3 scripts/draw_figures.py graph"


@pytest.mark.parametrize("name", ["foxglove_layout.json", "limb.rviz"])
def test_a_layout_shows_topics_and_fields_that_exist(name):
    nodes = json.loads(reference.GRAPH.read_text()).values()
    kinds = {
        f"/limb/{topic}": kind for node in nodes for topic, (kind, _) in node["publishes"].items()
    }
    shown = re.findall(r"/limb/([a-z_/]+)\.?([a-z_.]*)", (LAYOUTS / name).read_text())
    assert len(shown) >= 2
    for topic, field in shown:
        package, _, kind = kinds[f"/limb/{topic}"].split("/")
        message = getattr(importlib.import_module(f"{package}.msg"), kind)()
        for part in filter(None, field.split(".")):
            message = getattr(message, part)
