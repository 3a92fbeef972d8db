"""Packages have one version and dependencies that rosdep knows; a missing extra is named."""

import importlib.metadata
import re
import sys
from xml.etree import ElementTree

import pytest

import set_version
from limb_interfaces.entry import run_module
from workspace_setup.basics import PACKAGES, ROOT

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
OF_ROS = {
    *("action_msgs", "ament_cmake", "ament_cmake_python", "builtin_interfaces", "diagnostic_msgs"),
    *("geometry_msgs", "nav_msgs", "rcl_interfaces", "rclpy", "rosidl_default_generators"),
    *("rosidl_default_runtime", "sensor_msgs", "std_msgs", "std_srvs", "visualization_msgs"),
    *("rosgraph_msgs", "ament_index_python", "ament_cmake_pytest"),
}


@pytest.mark.parametrize("package", PACKAGES)
def test_dependencies_have_keys(package):
    root = ElementTree.parse(ROOT / "src" / package / "package.xml").getroot()
    named = {item.text for item in root if item.tag.endswith("depend")}
    assert named <= KEYS | OF_ROS | set(PACKAGES)
    assert root.findtext("url")
    assert root.findtext("author")


def test_a_node_without_an_extra_names_it(monkeypatch, capsys, tmp_path):
    (tmp_path / "lonely.py").write_text("import nicegui")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "nicegui", None)
    monkeypatch.setattr("limb_interfaces.entry.on_end_signals", lambda _: None)
    assert run_module("lonely") == 1
    assert "pip install nicegui" in capsys.readouterr().err


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
