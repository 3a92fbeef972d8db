"""The site is built without a complaint; each topic is described; packages say what they need."""

import importlib
import importlib.metadata
import json
import re
import sys
from xml.etree import ElementTree

import pytest
from ament_index_python.packages import get_packages_with_prefixes

import set_version
from documentation import build, reference
from figures import graph
from limb_interfaces import topics
from limb_interfaces.entry import run_module
from workspace_setup.basics import PACKAGES, ROOT

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


KEYS = {
    "python3-matplotlib",
    "python3-numba",
    "python3-numpy",
    "python3-opencv",
    "python3-psutil",
    "python3-pytest",
    "python3-scipy",
    "python3-serial",
    "python3-yaml",
}
"""The rosdep keys that are used; all stand in rosdep's python.yaml."""


@pytest.mark.parametrize("package", PACKAGES)
def test_dependencies_have_keys(package):
    root = ElementTree.parse(ROOT / "src" / package / "package.xml").getroot()
    named = {item.text for item in root if item.tag.endswith("depend")}
    assert named <= KEYS | set(get_packages_with_prefixes())  # those of ROS, and ours
    assert root.findtext("url")
    assert root.findtext("author")


def test_a_node_without_an_extra_names_it(monkeypatch, capsys, tmp_path):
    (tmp_path / "lonely.py").write_text("import nicegui")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "nicegui", None)
    monkeypatch.setattr("limb_interfaces.entry.on_end_signals", lambda _: None)
    monkeypatch.setattr(sys, "argv", ["node", "--ros-args", "-p", "port:=/dev/ttyACM0", "--"])
    assert run_module("lonely") == 1
    assert "pip install nicegui" in capsys.readouterr().err


@pytest.mark.parametrize(("words", "code"), [(["-p", "pressure_limit:=2.0"], 2), (["--help"], 0)])
def test_a_node_takes_no_arguments_outside_of_ros_args(monkeypatch, capsys, words, code):
    monkeypatch.setattr("limb_interfaces.entry.on_end_signals", lambda _: None)
    monkeypatch.setattr(sys, "argv", ["node", *words, "--ros-args", "-p", "port:=/dev/ttyACM0"])
    assert run_module("never_loaded") == code
    assert f"'{' '.join(words)}' stands outside of --ros-args" in capsys.readouterr().err


def test_every_package_has_the_version_of_the_project_also_where_it_is_installed():
    stated = set_version.versions()
    assert len(stated) == 5
    packages = [path.parent.name for path in ROOT.glob("src/*/setup.py")]
    assert len(packages) == 3
    installed = [importlib.metadata.version(package) for package in packages]
    assert {*stated.values(), *installed} == {stated["pyproject.toml"]}


def test_the_change_log_names_the_version():
    text = (ROOT / "CHANGELOG.md").read_text()
    released = re.findall(r"^## (\d+\.\d+\.\d+)", text, flags=re.MULTILINE)
    assert released[0] == set_version.versions()["pyproject.toml"]
