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
        timeout=200,
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


def _answer(source: Path) -> str:
    package = source / "robot"
    command = "from robot.inner.caller import twice; print(twice())"
    found = subprocess.run(
        [sys.executable, "-c", command], cwd=package, capture_output=True, text=True, check=True
    )
    return found.stdout.strip()


def test_a_kernel_is_compiled_again_when_one_that_it_calls_has_changed(tmp_path: Path):
    from workspace_setup.building import drop_stale_kernels, kernel_digests

    inner = tmp_path / "robot" / "robot" / "inner"
    inner.mkdir(parents=True)
    (inner / "called.py").write_text(
        "from numba import njit\n\n\n@njit(cache=True)\ndef one():\n    return 1\n"
    )
    (inner / "caller.py").write_text(
        "from numba import njit\nfrom robot.inner.called import one\n\n\n"
        "@njit(cache=True)\ndef twice():\n    return 2 * one()\n"
    )
    (inner / "plain.py").write_text("HERE = 1\n")
    before = kernel_digests(tmp_path)
    assert list(before) == ["robot/inner"]
    assert _answer(tmp_path) == "2"
    (inner / "plain.py").write_text("HERE = 2\n")
    assert kernel_digests(tmp_path) == before

    text = (inner / "called.py").read_text()
    (inner / "called.py").write_text(text.replace("return 1", "return 10"))
    assert kernel_digests(tmp_path) != before
    assert _answer(tmp_path) == "2", "numba notices by itself now: the caches need not be dropped"
    drop_stale_kernels(tmp_path, ["robot/inner"])
    assert _answer(tmp_path) == "20"


def test_every_kernel_of_the_workspace_is_in_a_group():
    from workspace_setup.building import kernel_digests

    with_kernels = {"model", "pcc", "rod", "twin"}
    groups = {"apriltag_tracker", *(f"der_planner/{name}" for name in with_kernels)}
    assert set(kernel_digests(ROOT / "src")) == groups
