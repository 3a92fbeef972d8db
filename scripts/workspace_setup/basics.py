"""Places, progress and long commands: what every part of the set-up needs."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
VENV = ROOT / ".venv"
APT_ROS = Path("/opt/ros/jazzy")
PACKAGES = ("der_msgs", "der_planner", "pressure_driver", "apriltag_tracker")
INSIDE = "DER_LIMB_WORKSPACE"


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


def run_logged(command: list[str], log: Path, what: str, environment: dict[str, str]) -> None:
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


def clean_environment() -> dict[str, str]:
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
