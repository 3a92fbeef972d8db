"""Limb files and tables of a `LinkChain`, found from its own log as those of any limb are."""

from __future__ import annotations

import functools
import hashlib
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from link_chain import LinkChain, Mass

import der_planner
from der_planner.identification import CalibrationLog, fit
from der_planner.limb import Limb

CACHE = Path(tempfile.gettempdir()) / "der_limb_link_chains"
Gravity = tuple[float, float, float]


@functools.cache
def calibrated(
    seed: int, gravity: Gravity = (0.0, 0.0, 0.0), masses: tuple[Mass, ...] = (), quick: bool = True
) -> Limb:
    """Return the limb that `fit` finds from the log of a chain.

    It takes ten seconds; the result is kept on disk for as long as no source of the package and
    of the chain changes.
    """
    digest = hashlib.sha256(repr((seed, gravity, masses, quick)).encode())
    sources = [*Path(der_planner.__file__).parent.rglob("*.py"), *Path(__file__).parent.glob("*")]
    for path in sorted(path for path in sources if path.suffix == ".py"):
        digest.update(path.read_bytes())
    file = CACHE / f"{digest.hexdigest()[:24]}.yaml"
    if not file.exists():
        chain = LinkChain(seed, gravity, masses)
        limb, _ = fit(prior(gravity, masses), chain.log(quick=quick))
        CACHE.mkdir(exist_ok=True)
        partial = file.with_suffix(f".{id(limb)}")
        limb.to_yaml(partial)
        partial.replace(file)
    return Limb.from_yaml(file)


def prior(gravity: Gravity = (0.0, 0.0, 0.0), masses: tuple[Mass, ...] = ()) -> Limb:
    """Return what is known of a chain before it is calibrated: the default limb, its loads."""
    limb = replace(Limb.default(), gravity=gravity)
    for at, mass in masses:
        limb = limb.carrying(mass, at)
    return limb


def write_csv(log: CalibrationLog, table: Path, columns: Path) -> None:
    """Write a log as CSV, pressures in hPa and angles in degrees, and the map of its columns."""
    chambers = np.zeros((len(log.time), 2 * log.segment_count))
    chambers[:, 0::2] = 1013.0 + 0.01 * log.measured_differential
    chambers[:, 1::2] = 1013.0
    parts = {
        "t": log.time[:, None],
        "u": 0.01 * log.commanded_differential,
        "p": chambers,
        "theta": np.degrees(log.bend_angles),
        "tip": log.tip,
    }
    names = {
        key: [f"{key}{i}" for i in range(part.shape[1])] if key != "t" else ["t"]
        for key, part in parts.items()
    }
    header = ",".join(name for part in names.values() for name in part)
    values = np.concatenate(list(parts.values()), axis=1)
    np.savetxt(table, values, delimiter=",", header=header, comments="", fmt="%.8g")
    content = {
        "time": "t",
        "commanded": names["u"],
        "chambers": names["p"],
        "angles": names["theta"],
        "tip": names["tip"],
        "pressure_unit": "hPa",
        "angle_unit": "deg",
    }
    columns.write_text(yaml.safe_dump(content))
