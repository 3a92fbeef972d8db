"""How long a fit takes, how it grows, and how well the fitted limb predicts unseen motions."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from der_planner.identification import (
    CalibrationLog,
    Excitation,
    calibration_run,
    fit,
    predict,
    record_twin,
)
from der_planner.identification.excitation import PERIOD
from der_planner.limb import Limb

AMPLITUDE = 18_000.0
"""Largest differential pressure of the calibration runs [Pa]."""
FRESH_SEEDS = (101, 102, 103, 104, 105)
"""Twins that no setting of the fit was chosen on."""


def _unseen() -> Excitation:
    instants = np.arange(0.0, 40.0, PERIOD)
    waves = [1.0 - np.cos(instants / 3.0), np.sin(instants / 2.0)]
    return Excitation(instants, 9000.0 * np.stack(waves, axis=1), ())


def _fitted(log: CalibrationLog) -> tuple[Limb, float]:
    begin = time.process_time()
    limb, _ = fit(Limb.default(), log)
    return limb, time.process_time() - begin


def _tip_error(limb: Limb, log: CalibrationLog, model: str) -> NDArray[np.float64]:
    """Return the open-loop error of the tip (K,) over the limb's length."""
    tip = predict(limb, log.time, log.measured_differential, model).tip
    error: NDArray[np.float64] = np.linalg.norm(tip - log.tip, axis=1) / limb.length
    return error


def run(quick: bool) -> dict[str, float | str]:
    """Measure; prints a table and returns every figure."""
    figures: dict[str, float | str] = {}
    print("fit: length of the log [s], processor time [s]")
    for short in (True,) if quick else (True, False):
        excitation = calibration_run(AMPLITUDE, quick=short)
        _, seconds = _fitted(record_twin(FRESH_SEEDS[0], excitation))
        length = float(excitation.time[-1])
        figures[f"fit_of_{length:.0f}s_log_cpu_s"] = seconds
        print(f"  {length:6.0f}  {seconds:6.2f}", flush=True)
    print("unseen motion, tip error in % of the limb's length: mean (max)")
    print("  seed   DER            PCC            not calibrated")
    for seed in FRESH_SEEDS[:2] if quick else FRESH_SEEDS:
        limb, _ = _fitted(record_twin(seed, calibration_run(AMPLITUDE, quick=True)))
        log = record_twin(seed, _unseen(), run=2)
        cells = []
        for name, robot, model in (
            ("der", limb, "der"),
            ("pcc", limb, "pcc"),
            ("uncalibrated", Limb.default(), "der"),
        ):
            error = 100.0 * _tip_error(robot, log, model)
            figures[f"seed_{seed}_{name}_mean_percent"] = float(error.mean())
            figures[f"seed_{seed}_{name}_max_percent"] = float(error.max())
            cells.append(f"{error.mean():5.2f} ({error.max():5.2f})")
        print(f"  {seed:4d}  {'  '.join(cells)}", flush=True)
    return figures
