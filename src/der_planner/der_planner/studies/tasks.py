"""What a row of a study does: from the values of its factors to its results.

A task is a plain function of its rows: no clock, no random state, no thread of a linear algebra
library, so that a row is the same to the last digit wherever and whenever it is computed.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from threadpoolctl import threadpool_limits

import der_planner
from der_planner.arrays import Array, rms_distance
from der_planner.control import Feedback, Learner, lockstep
from der_planner.identification import FitReport, calibrate_twin, predict, record_twin
from der_planner.identification.excitation import TIP_NOISE, Excitation
from der_planner.limb import Limb, Load, Pneumatics, declarations
from der_planner.model import CONTROL_PERIOD, simulate
from der_planner.planning import Motion, Plan, plan
from der_planner.studies.factors import (
    ERROR,
    IDENTIFICATION,
    MODEL,
    RUN,
    StudyError,
    Value,
    split_error,
    with_defaults,
)
from der_planner.twin.hardware import draw, known_values
from der_planner.twin.offline import LEAD, OfflineTwin
from pressure_driver.emulator import pneumatics

Values = Mapping[str, Value]
Result = dict[str, float]
_FIRST_LEARNING_RUN = 10
"""Runs of a twin's hardware from here on are learned from; the one that counts is run 0."""
UNSEEN_RUN = 2
"""The run of a twin's hardware on which an identified limb is tried."""
_PARTS = ("limb", "rod", "model", "estimation", "identification", "twin", "planning", "control")
"""Parts of der_planner on which a row and a calibrated twin depend."""
_BESIDE = ("arrays.py", "data/default_limb.yaml", "studies/factors.py", "studies/tasks.py")
"""Files of der_planner beside those parts, of the same."""
_LIBRARIES = ("numpy", "scipy", "numba", "pyelastica", "piqp")


@dataclass(frozen=True)
class Task:
    """One kind of row.

    Attributes:
        name: in the study's file.
        text: what a row does.
        columns: of its result, each with what it is.
        work: from a limb file's text and a row with its defaults to the row's results.
        calibrated: a row begins with the limb that a calibration of its twin found.
    """

    name: str
    text: str
    columns: Mapping[str, str]
    work: Callable[[str, Mapping[str, Any]], Result]
    calibrated: bool = False

    def compute(self, limb: str, values: Values) -> Result:
        """Return the results of a row, by column."""
        return self.work(limb, with_defaults(values, self.name))

    def twin(self, values: Values) -> Twin | None:
        """Return the calibrated twin that a row needs, if any."""
        row = with_defaults(values, self.name)
        if not self.calibrated or row["calibration"] == "none":
            return None
        return Twin.of(row)


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

    @classmethod
    def of(cls, row: Mapping[str, Any]) -> Twin:
        """Return the twin of a row with its defaults."""
        return cls(row["seed"], row["calibration"], row["tag_noise"], row["mounting"])

    def fit(self, prior: Limb) -> tuple[Limb, FitReport]:
        """Play a calibration and fit the prior to what camera and board would measure.

        Raises:
            LogError: the run does not tell the parameters.
        """
        quick, mounted = self.calibration == "quick", prior.mounted(self.mounting)
        return calibrate_twin(self.seed, mounted, quick=quick, noise=self.noise)


# What a machine keeps: calibrated twins, by what they depend on ----------------------------------


@lru_cache(maxsize=1)
def digest() -> str:
    """Return the digest of sources and of the versions of the libraries that compute."""
    found = hashlib.sha256(" ".join(f"{name} {version(name)}" for name in _LIBRARIES).encode())
    root = Path(next(iter(der_planner.__path__)))
    files = [file for part in _PARTS for file in sorted((root / part).rglob("*.py"))]
    files += [root / name for name in _BESIDE] + [Path(str(pneumatics.__file__))]
    for file in files:
        found.update(file.name.encode() + file.read_bytes())
    return found.hexdigest()[:16]


def calibrated(twin: Twin, prior: str) -> str:
    """Return the limb file's text of a calibrated twin, from the machine's cache if it is there.

    The cache is the folder DER_LIMB_CACHE, or ~/.cache/der_limb. Two processes that ask for the
    same twin at once compute it once: the second one waits.

    Args:
        twin: which, and how.
        prior: text of the limb file that the fit begins with; empty for the default limb.
    """
    about = repr((tuple(twin), prior, digest()))
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "der_limb"
    folder = Path(os.environ.get("DER_LIMB_CACHE") or home) / "twins"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{hashlib.sha256(about.encode()).hexdigest()[:32]}.yaml"
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # it ends with a killed process
        if not path.exists():
            with threadpool_limits(1):  # more threads change the last digits
                limb, _ = twin.fit(limb_of(prior))
            # What a fit took of the clock differs from run to run; the limb does not.
            replace(limb, provenance={"source": f"{twin}"}).to_yaml(path)
        return path.read_text(encoding="utf-8")


@lru_cache(maxsize=64)
def limb_of(text: str) -> Limb:
    """Return the limb of a limb file's text; the default limb for an empty one."""
    return Limb.from_mapping(yaml.safe_load(text)) if text else Limb.default()


# run: a calibrated twin plays a plan ------------------------------------------------------------

_ERRORS = {
    "mean_error_m": "mean distance of the tip from the reference",
    "mean_error_x_m": "mean |x − x̄|",
    "mean_error_y_m": "mean |y − ȳ|",
    "rms_error_m": "root mean square distance",
    "max_error_m": "largest distance",
    "predicted_error_m": "mean distance that the plan's own model expects",
}


def _errors(planned: Plan, tip: Array) -> Result:
    """Return the errors of a tip (K, 2) at the setpoints [m], as an experiment's table."""
    error = tip - planned.tip_reference
    distance = np.linalg.norm(error, axis=1)
    return {
        "mean_error_m": float(distance.mean()),
        "mean_error_x_m": float(np.abs(error[:, 0]).mean()),
        "mean_error_y_m": float(np.abs(error[:, 1]).mean()),
        "rms_error_m": rms_distance(error),
        "max_error_m": float(distance.max()),
        "predicted_error_m": planned.predicted_error,
    }


def _loaded(limb: Limb, row: Mapping[str, Any]) -> Limb:
    """Return a limb as a row mounts it, with the row's payload."""
    return limb.loaded(Load(row["payload"], row["payload_at"], row["mounting"]))


def _planned(limb: Limb, row: Mapping[str, Any]) -> Plan:
    limb = _loaded(limb, {**row, "payload": row["payload"] if row["payload_known"] == "yes" else 0})
    motion = Motion.named(
        row["motion"], amplitude=row["amplitude"], period=row["period"], cycles=row["cycles"]
    )
    method = "" if row["method"] == "best" else row["method"]
    return plan(limb, motion, model=row["model"], method=method)


def _run(limb: str, row: Mapping[str, Any]) -> Result:
    planned = _planned(with_errors(limb_of(limb), row), row)
    loads = _loaded(limb_of(limb), row)
    if row["learning_runs"]:
        planned = _learned(planned, loads, row)
    tip, held = _played(planned, loads, row, feedback=row["feedback"] == "on")
    return {
        **_errors(planned, tip),
        "pressure_rms_error_pa": float(np.sqrt(np.mean(held**2))),
        "plan_warns": float(len(planned.warnings) > 0),
    }


def _learned(planned: Plan, loads: Limb, row: Mapping[str, Any]) -> Plan:
    """Return the plan after runs of it on the same hardware, as a camera would have seen them."""
    learner = Learner(planned)
    for run in range(_FIRST_LEARNING_RUN, _FIRST_LEARNING_RUN + row["learning_runs"]):
        tip, beyond = _played(planned, loads, row, run)
        held = planned.time, planned.differential_pressure + beyond
        noise = np.random.default_rng([row["seed"], run]).standard_normal(tip.shape)
        learner.add(planned.time, tip + row["tag_noise"] * TIP_NOISE * noise, chambers=held)
        planned = learner.next()
        if learner.stopped:
            break
    return planned


def _played(
    planned: Plan, loads: Limb, row: Mapping[str, Any], run: int = 0, feedback: bool = False
) -> tuple[Array, Array]:
    """Return the twin's tips (K, 2) [m] and chamber less commanded pressures (K, M) [Pa]."""
    usual, noise, seed = lockstep.Sensors(), row["tag_noise"], row["seed"]
    sensors = replace(
        usual,
        # Without feedback nobody looks at pictures: none is taken between two commands.
        frame_rate=usual.frame_rate if feedback else 1.0 / CONTROL_PERIOD,
        latency=row["latency"],
        bend_noise=noise * usual.bend_noise,
        tip_noise=noise * usual.tip_noise,
        pressure_noise=noise * usual.pressure_noise,
        seed=seed,
    )
    count = loads.segment_count
    plant = OfflineTwin(seed, run, segment_count=count, gravity=loads.gravity, masses=loads.masses)
    plant.rest(LEAD)
    played = lockstep.play(planned, plant, Feedback(planned) if feedback else None, sensors)
    return played.tip, played.differential_pressure - played.commanded


# model: the rod itself plays a plan that was made for another rod --------------------------------


def _model(limb: str, row: Mapping[str, Any]) -> Result:
    """Plan for the limb, and play on one whose parameters are other by the errors."""
    motion = {name: value for name, value in row.items() if not name.startswith(ERROR)}
    planned = _plan_once(limb, json.dumps(motion, sort_keys=True))
    true = _loaded(with_errors(limb_of(limb), row), row)
    response = simulate(true, planned.time, commands=planned.differential_pressure)
    return _errors(planned, response.tip[:-1])


@lru_cache(maxsize=8)
def _plan_once(limb: str, motion: str) -> Plan:
    return _planned(limb_of(limb), json.loads(motion))


# identification: what a calibration finds of what the twin knows --------------------------------

_RECOVERED = (
    *("gain", "gain_asymmetry", "pressure_stiffening", "cubic", "friction_pressure"),
    *("friction_angle", "creep_pressure", "coupling_before", "coupling_after", "rest_angle"),
)


def unseen_motion() -> Excitation:
    """Return pressures that no calibration has played."""
    instants = np.arange(0.0, 40.0, CONTROL_PERIOD)
    waves = [1.0 - np.cos(instants / 3.0), np.sin(instants / 2.0)]
    return Excitation(9000.0 * np.stack(waves, axis=1))


def _identify(limb: str, row: Mapping[str, Any]) -> Result:
    """Compare what a calibration found with what the seed drew, and predict an unseen motion.

    Raises:
        StudyError: there is no calibration.
    """
    if row["calibration"] == "none":
        raise StudyError("calibration none finds nothing: choose quick or long")
    found, report = Twin.of(row).fit(limb_of(limb))
    distances: dict[str, list[float]] = {}
    for name, known in known_values(draw(row["seed"])).items():
        unknown = report.value(name)
        deviation = float(np.hypot(unknown.deviation, known.spread))
        distances.setdefault(name.split("[", maxsplit=1)[0], []).append(
            (unknown.value - known.value) / deviation
        )
    together = np.abs(np.concatenate(list(distances.values())))
    log = record_twin(row["seed"], unseen_motion(), run=UNSEEN_RUN, noise=0.0, limb=found)
    tip = predict(found, log.time, log.measured_differential).tip
    error = np.linalg.norm(tip - log.tip, axis=1)
    return {
        "within_1_deviation": float(np.mean(together < 1)),
        "within_2_deviations": float(np.mean(together < 2)),
        "largest_deviations": float(together.max()),
        "fit_residual_rad": float(np.sqrt(np.mean(report.residual**2))),
        "unseen_mean_error_m": float(error.mean()),
        "unseen_max_error_m": float(error.max()),
        **{
            f"{name}_deviations": float(np.sqrt(np.mean(np.square(distances.get(name, [np.nan])))))
            for name in _RECOVERED
        },
    }


TASKS = {
    RUN: Task(
        RUN,
        "plan for a twin as it was calibrated, play on the twin, compare its true tip with r̄",
        {
            **_ERRORS,
            "pressure_rms_error_pa": "root mean square of chamber less commanded pressures",
            "plan_warns": "1 where the plan warns: limits, venting, loads, a range that was left",
        },
        _run,
        calibrated=True,
    ),
    MODEL: Task(
        MODEL,
        "plan for a limb, play on the rod of a limb whose parameters are other by error.…",
        _ERRORS,
        _model,
    ),
    IDENTIFICATION: Task(
        IDENTIFICATION,
        "calibrate a twin, compare what is found with what the twin knows",
        {
            "within_1_deviation": "share of the known numbers found within one stated deviation",
            "within_2_deviations": "the same within two",
            "largest_deviations": "largest error in stated deviations",
            "fit_residual_rad": "root mean square bend angle error of the calibration",
            "unseen_mean_error_m": "mean tip error in predicting an unseen motion",
            "unseen_max_error_m": "largest tip error there",
            **{
                f"{name}_deviations": f"error of {name} in stated deviations, root mean square"
                for name in _RECOVERED
            },
        },
        _identify,
    ),
}


# Shared ------------------------------------------------------------------------------------------


def with_errors(limb: Limb, row: Mapping[str, Any]) -> Limb:
    """Return a limb whose parameters are larger by the row's relative errors (``error.NAME``)."""
    for name, error in row.items():
        if not name.startswith(ERROR):
            continue
        parameter, segment = split_error(name)
        if parameter in declarations(Pneumatics):
            value = getattr(limb.pneumatics, parameter) * (1.0 + error)
            limb = replace(limb, pneumatics=replace(limb.pneumatics, **{parameter: value}))
        else:
            limb = limb.scaled(parameter, 1.0 + error, segment)
    return limb
