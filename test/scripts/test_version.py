"""All packages share one version, which the change log names."""

import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def test_every_package_has_the_version_of_the_project():
    import set_version

    stated = set_version.versions()
    assert len(stated) == 5
    assert len(set(stated.values())) == 1, stated


@pytest.mark.parametrize("package", ["der_planner", "pressure_driver", "apriltag_tracker"])
def test_the_installed_package_takes_its_version_from_package_xml(package: str):
    script = "import setuptools, sys; sys.argv = ['setup.py', '--version']; import setup"
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=ROOT / "src" / package,
        capture_output=True,
        text=True,
        check=True,
    )
    text = (ROOT / "src" / package / "package.xml").read_text()
    wanted = re.search(r"<version>(.*)</version>", text)[1]
    assert done.stdout.split()[-1] == wanted
    assert importlib.metadata.version(package) == wanted


def test_the_change_log_names_the_version():
    import set_version

    text = (ROOT / "CHANGELOG.md").read_text()
    released = re.findall(r"^## (\d+\.\d+\.\d+)", text, flags=re.MULTILINE)
    assert released[0] == set_version.versions()["pyproject.toml"]
