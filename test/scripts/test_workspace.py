"""The set-up: what it needs, what it notices, and what it leaves alone."""

from __future__ import annotations

import importlib.util
import os
import re
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


def _complaint(clone: Path, path: str = os.environ["PATH"]) -> str:
    """Return what a set-up that is refused says."""
    result = subprocess.run(
        [Path(sys.base_prefix) / "bin" / "python3", clone / "scripts" / "workspace.py", "setup"],
        env={"PATH": path, "HOME": os.environ.get("HOME", "/")},
        capture_output=True, text=True, check=False, timeout=200,
    )  # fmt: skip
    assert result.returncode == 1
    return result.stderr


def test_a_machine_without_compiler_is_told_the_command(bare_clone: Path, tmp_path: Path):
    assert "no C++ compiler: sudo apt-get install g++" in _complaint(bare_clone, str(tmp_path))
    assert not (bare_clone / ".venv").exists()


def test_an_unsupported_python_is_named(bare_clone: Path):
    script = bare_clone / "scripts" / "workspace_setup" / "building.py"
    script.write_text(script.read_text().replace("((3, 10), (3, 13))", "((3, 5), (3, 6))"))
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    assert f"this is Python {version}" in _complaint(bare_clone)


def test_an_environment_that_was_made_under_another_path_is_left_alone(bare_clone: Path):
    made_for = bare_clone / ".venv" / "made-for.txt"
    made_for.parent.mkdir()
    made_for.write_text(f"{sys.version_info[:2]} {sys.base_prefix} /elsewhere/.venv")
    assert "was made as /elsewhere/.venv" in _complaint(bare_clone)
    assert made_for.exists()


def test_the_environment_holds_nothing_of_another_workspace(monkeypatch: pytest.MonkeyPatch):
    import workspace

    monkeypatch.setenv("PYTHONPATH", "/somebody/elses/packages")
    monkeypatch.setenv("CMAKE_PREFIX_PATH", "/somebody/elses/ros")
    inside = workspace.environment()
    assert "/somebody/elses" not in inside["PYTHONPATH"]
    assert "/somebody/elses" not in inside["CMAKE_PREFIX_PATH"]
    for package in workspace.PACKAGES:
        assert f"install/{package}" in inside["AMENT_PREFIX_PATH"]


def test_each_script_runs_a_module_that_is_there():
    texts = [path.read_text() for path in (ROOT / "scripts").glob("*.py")]
    modules = re.findall(r'workspace\.run\("([\w.]+)"\)', "\n".join(texts))
    assert len(modules) > 10
    assert [module for module in modules if importlib.util.find_spec(module) is None] == []


def test_a_package_that_is_gone_is_built_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from workspace_setup import building

    assert building.build_jobs() == []
    for package in building.PACKAGES:
        (tmp_path / package).symlink_to(ROOT / "install" / package)
    monkeypatch.setattr(building, "INSTALL", tmp_path)
    assert building.build_jobs() == []
    (tmp_path / "der_planner").unlink()
    assert len(building.build_jobs()) == 1


@pytest.mark.slow
def test_jobs_run_beside_each_other_and_a_failed_one_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    from workspace_setup import basics

    monkeypatch.setattr(basics, "ROOT", tmp_path)
    monkeypatch.setattr(basics, "PROGRESS", 0.1)
    finished = []

    def job(name: str, script: str) -> basics.Job:
        command = ["/bin/sh", "-c", script]
        return basics.Job(name, command, {}, name, lambda: finished.append(name))

    # Each waits for the other's file.
    meet = "touch {0}; while [ ! -e {1} ]; do :; done; /bin/sleep 0.5"
    basics.run_jobs(job("one", meet.format("a", "b")), job("two", meet.format("b", "a")))
    assert sorted(finished) == ["one", "two"]
    assert "one; two" in capsys.readouterr().err
    with pytest.raises(basics.SetupError, match=r"bad failed(.|\n)*why"):
        basics.run_jobs(job("bad", "echo why; exit 3"), job("good", "true"))
    assert finished[2:] == ["good"]


def test_a_changed_kernel_drops_the_caches_of_the_tracker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    from workspace_setup import basics, building

    for module in (basics, building):
        monkeypatch.setattr(module, "ROOT", tmp_path)
    package = tmp_path / "src" / "apriltag_tracker" / "apriltag_tracker"
    cache = package / "camera" / "__pycache__" / "lens.distort-1.py311.nbi"
    cache.parent.mkdir(parents=True)
    kernel, plain = package / "kernel.py", package / "plain.py"
    kernel.write_text("@njit(cache=True)\ndef one(): return 1\n")
    plain.write_text("HERE = 1\n")
    for job in building.kernel_jobs():
        job.finish()
    cache.touch()
    plain.write_text("HERE = 2\n")
    assert building.kernel_jobs() == []
    assert cache.exists()
    kernel.write_text("@njit(cache=True)\ndef one(): return 10\n")
    assert len(building.kernel_jobs()) == 2
    assert not cache.exists()
