"""What is built: messages and packages with colcon, and numba's kernels."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable
from pathlib import Path

from workspace_setup.basics import (
    PACKAGES,
    ROOT,
    VENV,
    Job,
    clean_environment,
    file_digest,
    ros_setup_lines,
)

INSTALL = ROOT / "install"
_COMPILED = re.compile(r"^@(\w+\.)?(njit|\w*kernel)\b", re.MULTILINE)
_ONE_GROUP = ("apriltag_tracker",)
HALVES = ("plane", "space")
"""Halves of the kernels; `workspace_setup.kernels` says what belongs to each."""


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


def kernel_jobs() -> list[Job]:
    """Return what compiles kernels that are new or changed, before several nodes do it at once.

    Half of the kernels call none of the other half, so each half has a process of its own. Both
    need only the sources: the packages may be built beside them.
    """
    source, stamp = ROOT / "src", ROOT / "build" / "kernels.json"
    digests = kernel_digests(source)
    known = json.loads(stamp.read_text()) if stamp.exists() else {}
    changed = [name for name, digest in digests.items() if known.get(name) != digest]
    if not changed:
        return []
    drop_stale_kernels(source, changed)
    paths = [str(ROOT / "scripts"), *(str(source / package) for package in PACKAGES)]
    inside = {**clean_environment(), "PYTHONPATH": os.pathsep.join(paths)}
    done: list[str] = []

    def finish() -> None:
        done.append("half")
        if len(done) == len(HALVES):
            stamp.parent.mkdir(exist_ok=True)
            stamp.write_text(json.dumps(digests, indent=1) + "\n")

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
