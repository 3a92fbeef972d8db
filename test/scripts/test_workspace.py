"""Set-up says what the machine lacks, by name and with the remedy."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent.parent


@pytest.fixture
def bare_clone(tmp_path: Path) -> Path:
    """Return a folder with the set-up script and nothing installed."""
    shutil.copytree(ROOT / "requirements", tmp_path / "requirements")
    scripts = ROOT / "scripts"
    shutil.copytree(scripts / "workspace_setup", tmp_path / "scripts" / "workspace_setup")
    shutil.copy(scripts / "workspace.py", tmp_path / "scripts")
    return tmp_path


def _setup(clone: Path, path: Path) -> subprocess.CompletedProcess[str]:
    base = Path(sys.base_prefix) / "bin" / "python3"
    clean = {"PATH": str(path), "HOME": os.environ.get("HOME", "/")}
    return subprocess.run(
        [base, clone / "scripts" / "workspace.py", "setup"],
        env=clean,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )


def test_a_machine_without_compiler_is_told_the_command(bare_clone: Path, tmp_path: Path):
    empty = tmp_path / "bin"
    empty.mkdir()
    result = _setup(bare_clone, empty)
    assert result.returncode == 1
    assert "no C++ compiler: sudo apt-get install g++" in result.stderr
    assert not (bare_clone / ".venv").exists()


def test_an_unsupported_python_is_named(bare_clone: Path, tmp_path: Path):
    script = bare_clone / "scripts" / "workspace_setup" / "python_packages.py"
    script.write_text(script.read_text().replace("((3, 10), (3, 13))", "((3, 5), (3, 6))"))
    result = _setup(bare_clone, tmp_path)
    assert result.returncode == 1
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    assert f"this is Python {version}" in result.stderr


def test_the_environment_holds_nothing_of_another_workspace(monkeypatch: pytest.MonkeyPatch):
    import workspace

    monkeypatch.setenv("PYTHONPATH", "/somebody/elses/packages")
    monkeypatch.setenv("CMAKE_PREFIX_PATH", "/somebody/elses/ros")
    inside = workspace.environment()
    assert "/somebody/elses" not in inside["PYTHONPATH"]
    assert "/somebody/elses" not in inside["CMAKE_PREFIX_PATH"]
    for package in workspace.PACKAGES:
        assert f"install/{package}" in inside["AMENT_PREFIX_PATH"]
