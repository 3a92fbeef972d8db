"""Digests of the sources that results depend on, and the cache of each machine.

Sources are told apart by a digest, so that a cache or a worker of another version is noticed.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import tempfile
from collections.abc import Iterator
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

import der_planner
import pressure_driver

_LIMB = ("limb", "rod", "pcc", "model")
CALIBRATION = (*_LIMB, "identification", "twin")
"""Parts of der_planner on which a calibrated twin depends."""
EVERYTHING = (*CALIBRATION, "planning", "control", "runs", "studies/tasks.py", "studies/twins.py")
"""Parts of der_planner on which a row depends."""
_LIBRARIES = ("numpy", "scipy", "numba", "pyelastica", "piqp")


@lru_cache(maxsize=4)
def digest(parts: tuple[str, ...] = EVERYTHING) -> str:
    """Return the digest of sources and of the versions of the libraries that compute."""
    found = hashlib.sha256(" ".join(f"{name} {version(name)}" for name in _LIBRARIES).encode())
    root = Path(next(iter(der_planner.__path__)))
    emulator = Path(next(iter(pressure_driver.__path__))) / "emulator"
    for folder, pattern in [*((root, part) for part in parts), (emulator, "pneumatics.py")]:
        for path in sorted(folder.glob(pattern)):
            for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
                found.update(file.relative_to(folder).as_posix().encode())
                found.update(file.read_bytes())
    return found.hexdigest()[:16]


def cache() -> Path:
    """Return the cache folder of this machine: DER_LIMB_CACHE, or ~/.cache/der_limb.

    Where neither can be written, a folder of the user's in the system's temporary one.
    """
    given = os.environ.get("DER_LIMB_CACHE")
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "der_limb"
    spare = Path(tempfile.gettempdir()) / f"der_limb-{os.getuid()}"
    for folder in [Path(given)] if given else [home, spare]:
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            if os.access(folder, os.W_OK):
                return folder
    raise OSError(f"the cache {given or home} cannot be written: set DER_LIMB_CACHE to a folder")


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a lock that all processes of the machine share; it ends with a killed process."""
    with path.with_name(path.name + ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def write_whole(path: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        unfinished.write_bytes(data)
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)
