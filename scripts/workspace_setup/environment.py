"""The environment in which nodes, scripts and tests run, as sourcing the workspace makes it."""

from __future__ import annotations

import json
import os
import subprocess
import sys

from workspace_setup.basics import (
    APT_ROS,
    INSIDE,
    ROOT,
    VENV,
    SetupError,
    clean_environment,
    uses_apt_ros,
)


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
