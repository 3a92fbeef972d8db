"""What is built: messages and packages with colcon, and numba's kernels."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable
from pathlib import Path

from workspace_setup.basics import PACKAGES, ROOT, VENV, clean_environment, file_digest, run_logged
from workspace_setup.environment import environment, ros_setup_lines

_COMPILED = re.compile(r"^@(\w+\.)?(njit|\w*kernel)\b", re.MULTILINE)
_ONE_GROUP = ("apriltag_tracker",)


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


def kernel_digests(source: Path) -> dict[str, str]:
    """Return a hash over the kernels' sources in each folder below `source` that has some.

    A kernel calls those of its own folder and of the folders in it; folders of a package that call
    each other share one hash.
    """
    groups: dict[str, list[Path]] = {}
    for path in source.glob("*/*/**/*.py"):
        if "__pycache__" not in path.parts and _COMPILED.search(path.read_text()):
            package, _, *folders = path.relative_to(source).parts[:-1]
            name = package if package in _ONE_GROUP or not folders else f"{package}/{folders[0]}"
            groups.setdefault(name, []).append(path)
    return {
        name: hashlib.sha256(b"".join(path.read_bytes() for path in sorted(paths))).hexdigest()
        for name, paths in sorted(groups.items())
    }


def drop_stale_kernels(source: Path, changed: Iterable[str]) -> None:
    """Delete numba's caches of these groups: it looks only at a kernel's own file by itself."""
    for name in changed:
        package, *folder = name.split("/")
        for cache in (source / package / package).joinpath(*folder).rglob("__pycache__/*.nbi"):
            cache.unlink(missing_ok=True)


def compile_kernels() -> None:
    """Compile the kernels that are new or changed, before several nodes start and do it at once."""
    source, stamp = ROOT / "src", ROOT / "build" / "kernels.json"
    digests = kernel_digests(source)
    known = json.loads(stamp.read_text()) if stamp.exists() else {}
    changed = [name for name, digest in digests.items() if known.get(name) != digest]
    if not changed:
        return
    drop_stale_kernels(source, changed)
    command = [str(VENV / "bin" / "python"), str(ROOT / "scripts" / "compile_kernels.py")]
    what = f"compiling the kernels of {', '.join(changed)}"
    run_logged(command, ROOT / "log" / "kernels.log", what, environment())
    stamp.write_text(json.dumps(digests, indent=1) + "\n")
