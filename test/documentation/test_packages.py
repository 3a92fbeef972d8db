"""Packages depend on what rosdep knows; a node that lacks an extra names it."""

import sys
from xml.etree import ElementTree

import pytest

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
