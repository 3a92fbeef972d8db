"""Calibrated twins: each is computed once on a machine and then read from its cache."""

from __future__ import annotations

import hashlib
import tempfile
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import yaml
from threadpoolctl import threadpool_limits

from der_planner.identification import FitReport, calibration_run, fit, record_twin
from der_planner.identification.offline import AMPLITUDE
from der_planner.limb import Limb
from der_planner.studies.identity import CALIBRATION, cache, digest, locked, write_whole


@dataclass(frozen=True)
class Twin:
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
    prior = prior.mounted(twin.mounting)
    amplitude = AMPLITUDE * prior.pneumatics.pressure_limit
    excitation = calibration_run(amplitude, prior.segment_count, twin.calibration == "quick")
    limb, report = fit(prior, record_twin(twin.seed, excitation, noise=twin.noise, limb=prior))
    return replace(limb, name=f"{prior.name}, twin {twin.seed}"), report


def calibrated(twin: Twin, prior: str) -> str:
    """Return the limb file's text of a calibrated twin, from the machine's cache if it is there.

    Two processes that ask for the same twin at once compute it once: the second one waits.

    Args:
        twin: which, and how.
        prior: text of the limb file that the fit begins with; empty for the default limb.
    """
    about = repr((astuple(twin), prior, digest(CALIBRATION)))
    folder = cache() / "twins"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{hashlib.sha256(about.encode()).hexdigest()[:32]}.yaml"
    with locked(path), threadpool_limits(1):  # more threads change the last digits
        if not path.exists():
            limb, _ = fit_twin(twin, read_limb(prior) if prior else Limb.default())
            # What a fit took of the clock differs from run to run; the limb does not.
            write_whole(path, limb_text(replace(limb, provenance={"source": f"{twin}"})).encode())
        return path.read_text(encoding="utf-8")


def limb_text(limb: Limb) -> str:
    """Return the text of a limb's file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "limb.yaml"
        limb.to_yaml(path)
        return path.read_text(encoding="utf-8")


def read_limb(text: str) -> Limb:
    """Return the limb of a limb file's text."""
    return Limb.from_mapping(yaml.safe_load(text))
