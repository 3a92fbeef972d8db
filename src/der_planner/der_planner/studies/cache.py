"""What a machine keeps for studies: calibrated twins, by what they depend on.

Sources are told apart by a digest, so that a cache or a worker of another version is noticed.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import yaml
from threadpoolctl import threadpool_limits

import der_planner
import pressure_driver
from der_planner.identification import FitReport, calibrate_twin
from der_planner.limb import Limb

CALIBRATION = ("limb", "rod", "model", "identification", "twin")
"""Parts of der_planner on which a calibrated twin depends."""
EVERYTHING = (*CALIBRATION, "planning", "control", "studies/tasks.py", "studies/cache.py")
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


def cache_folder() -> Path:
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


class Twin(NamedTuple):
    """A twin and how it is calibrated.

    Attributes:
        seed: of the hardware.
        calibration: "quick" (90 s) or "long" (200 s).
        noise: of tags and board, as a multiple of the usual one.
        mounting: see `der_planner.limb.loads`.
    """

    seed: int
    calibration: str = "quick"
    noise: float = 1.0
    mounting: str = "horizontal"


def fit_twin(twin: Twin, prior: Limb) -> tuple[Limb, FitReport]:
    """Play a calibration on the twin and fit the prior to what camera and board would measure.

    Raises:
        LogError: the run does not tell the parameters.
    """
    quick = twin.calibration == "quick"
    return calibrate_twin(twin.seed, prior.mounted(twin.mounting), quick=quick, noise=twin.noise)


def calibrated(twin: Twin, prior: str) -> str:
    """Return the limb file's text of a calibrated twin, from the machine's cache if it is there.

    Two processes that ask for the same twin at once compute it once: the second one waits.

    Args:
        twin: which, and how.
        prior: text of the limb file that the fit begins with; empty for the default limb.
    """
    about = repr((tuple(twin), prior, digest(CALIBRATION)))
    folder = cache_folder() / "twins"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{hashlib.sha256(about.encode()).hexdigest()[:32]}.yaml"
    with locked(path), threadpool_limits(1):  # more threads change the last digits
        if not path.exists():
            limb, _ = fit_twin(twin, read_limb(prior) if prior else Limb.default())
            # What a fit took of the clock differs from run to run; the limb does not.
            limb = replace(limb, provenance={"source": f"{twin}"})
            with tempfile.TemporaryDirectory() as written:
                limb.to_yaml(Path(written) / "limb.yaml")
                write_whole(path, (Path(written) / "limb.yaml").read_bytes())
        return path.read_text(encoding="utf-8")


def read_limb(text: str) -> Limb:
    """Return the limb of a limb file's text."""
    return Limb.from_mapping(yaml.safe_load(text))
