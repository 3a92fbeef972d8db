"""Places, progress, long commands, and the environment in which nodes, scripts and tests run."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent.parent
VENV = ROOT / ".venv"
APT_ROS = Path("/opt/ros/jazzy")
PACKAGES = ("der_msgs", "der_planner", "pressure_driver", "apriltag_tracker")
INSIDE = "DER_LIMB_WORKSPACE"
"""Environment variable that names the workspace in which a process runs."""
FOREIGN = (
    "VIRTUAL_ENV", "PYTHONPATH", "PYTHONHOME", "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH",
    "COLCON_PREFIX_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH", INSIDE,
)  # fmt: skip
"""Environment variables that another workspace, virtual environment or ROS may have set."""
PROGRESS = 10.0
"""Time [s] between two lines of progress."""


class SetupError(RuntimeError):
    """The machine lacks something that only its owner can install; the message says the remedy."""


def say(text: str) -> None:
    """Print one line of progress to stderr."""
    print(f"[setup] {text}", file=sys.stderr, flush=True)


def uses_apt_ros() -> bool:
    """Tell whether this machine has ROS 2 Jazzy from apt."""
    return (APT_ROS / "setup.bash").exists()


def file_digest(paths: list[Path], extra: str = "") -> str:
    """Return a hash over the names and contents of files."""
    total = hashlib.sha256(extra.encode())
    for path in sorted(paths):
        total.update(str(path.relative_to(ROOT)).encode())
        total.update(path.read_bytes())
    return total.hexdigest()


class Job(NamedTuple):
    """A long command: what it does, its words, its environment, and the name of its log file."""

    what: str
    command: list[str]
    environment: dict[str, str]
    log_name: str
    finish: Callable[[], None] = lambda: None
    """Called when the command has succeeded."""

    @property
    def log(self) -> Path:
        """Return the file that its output goes to."""
        return ROOT / "log" / f"{self.log_name}.log"


def run_jobs(*jobs: Job) -> None:
    """Run commands beside each other; say every `PROGRESS` seconds which of them still run.

    Raises:
        SetupError: a command failed; the others have ended, too, and the message ends its log.
    """
    started = said = time.monotonic()
    running: list[tuple[Job, subprocess.Popen[bytes]]] = []
    failed = []
    for job in jobs:
        job.log.parent.mkdir(exist_ok=True)
        say(f"{job.what} (log: {job.log.relative_to(ROOT)})")
        with job.log.open("wb") as output:
            process = subprocess.Popen(
                job.command, stdout=output, stderr=output, env=job.environment, cwd=ROOT
            )
        running.append((job, process))
    while running:
        time.sleep(0.2)
        seconds = time.monotonic() - started
        for job, process in [each for each in running if each[1].poll() is not None]:
            running.remove((job, process))
            if process.returncode == 0:
                job.finish()
                say(f"{job.what}: done in {seconds:.0f} s")
            else:
                failed.append(job)
        if running and time.monotonic() - said >= PROGRESS:
            said = time.monotonic()
            say(f"{seconds:.0f} s: {'; '.join(job.what for job, _ in running)}")
    for job in failed:
        tail = "\n".join(job.log.read_text(errors="replace").splitlines()[-15:])
        raise SetupError(f"{job.what} failed. The end of {job.log.relative_to(ROOT)}:\n{tail}")


def clean_environment() -> dict[str, str]:
    """Return the caller's environment without another workspace, venv or ROS in it."""
    environment = dict(os.environ)
    for name in FOREIGN:
        environment.pop(name, None)
    return environment


def ros_setup_lines() -> list[str]:
    """Return the lines of a shell script that make ROS and .venv available."""
    if uses_apt_ros():
        return [f"source {APT_ROS}/setup.bash", f"source {VENV}/bin/activate"]
    return [
        f"source {VENV}/bin/activate",
        f'export AMENT_PREFIX_PATH="{VENV}" CMAKE_PREFIX_PATH="{VENV}"',
    ]


def _captured_environment() -> dict[str, str]:
    """Return what sourcing the workspace adds to an empty environment (kept in build/)."""
    kept = ROOT / "build" / "environment.json"
    if kept.exists():
        return dict(json.loads(kept.read_text()))
    lines = [*ros_setup_lines(), f"source {ROOT}/install/setup.bash", "env -0"]
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
    result = clean_environment()
    caller_path = result.get("PATH", "")
    for name, value in _captured_environment().items():
        result[name] = f"{value}{os.pathsep}{caller_path}" if name == "PATH" else value
    if not uses_apt_ros():
        result.update(_library_paths())
    result.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    result.setdefault("RCUTILS_COLORIZED_OUTPUT", "0")
    profile = ROOT / "src" / "apriltag_tracker" / "config" / "fastdds_large_images.xml"
    result.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(profile))
    if not os.access(result.get("HOME", ""), os.W_OK):  # ROS would not start without a log
        result.setdefault("ROS_LOG_DIR", tempfile.gettempdir())
    result[INSIDE] = str(ROOT)
    return result


def _library_paths() -> dict[str, str]:
    """Return what the wheels' start-up hook would set; saves every process a second start."""
    site = VENV / "lib" / f"python{sys.version_info[0]}.{sys.version_info[1]}" / "site-packages"
    captured = _captured_environment().get("LD_LIBRARY_PATH", "")
    folders = [str(VENV / "lib"), *sorted(str(path) for path in site.glob("ros_*.libs"))]
    folders += [part for part in captured.split(os.pathsep) if part and part not in folders]
    return {"LD_LIBRARY_PATH": os.pathsep.join(folders), "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"}
