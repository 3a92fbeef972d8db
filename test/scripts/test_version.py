"""All packages share one version, which the change log names."""

import importlib.metadata
import re
from pathlib import Path

import set_version

ROOT = Path(__file__).resolve().parents[2]


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
