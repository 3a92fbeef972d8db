"""What is built: messages and packages with colcon, and numba's kernels."""

from __future__ import annotations

import json
from pathlib import Path

from workspace_setup.basics import PACKAGES, ROOT, VENV, clean_environment, file_digest, run_logged
from workspace_setup.environment import environment, ros_setup_lines


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
    return file_digest(
        _build_inputs(), extra=(VENV / "made-for.txt").read_text() + "\n".join(configuration)
    )


def build() -> None:
    """Build the packages with colcon, unless nothing that they depend on has changed."""
    stamp = ROOT / "build" / "workspace.json"
    digest = _build_digest()
    if stamp.exists() and json.loads(stamp.read_text()).get("digest") == digest:
        return
    # `colcon` from the system would build for the system's Python.
    script = "\n".join(
        [
            "set -e",
            *ros_setup_lines(),
            f'"{VENV}/bin/python" -m colcon --log-base log build --base-paths src '
            f"--symlink-install --packages-select {' '.join(PACKAGES)} "
            f"--cmake-args -DCMAKE_BUILD_TYPE=Release -DBUILD_TESTING=OFF "
            f'-DPython3_EXECUTABLE="{VENV}/bin/python" -DPYTHON_EXECUTABLE="{VENV}/bin/python"',
        ]
    )
    run_logged(
        ["bash", "-c", script],
        ROOT / "log" / "colcon.log",
        f"building {', '.join(PACKAGES)} with colcon",
        clean_environment(),
    )
    stamp.write_text(json.dumps({"digest": digest}))
    (ROOT / "build" / "environment.json").unlink(missing_ok=True)


def compile_kernels() -> None:
    """Compile what numba compiles now, rather than in seven nodes at once at the first start."""
    stamp = ROOT / "build" / "kernels.txt"
    if stamp.exists():
        return
    command = [str(VENV / "bin" / "python"), str(ROOT / "scripts" / "compile_kernels.py")]
    run_logged(command, ROOT / "log" / "kernels.log", "compiling the kernels", environment())
    stamp.write_text("compiled\n")
