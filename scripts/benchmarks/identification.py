"""Time of a fit, what it recovers, what each of its terms is worth, and how well it predicts."""

from __future__ import annotations

import time
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from der_planner.identification import (
    CalibrationLog,
    Excitation,
    FitReport,
    calibration_run,
    fit,
    predict,
    record_twin,
)
from der_planner.identification.excitation import PERIOD
from der_planner.identification.parameters import GROUPS
from der_planner.limb import Limb
from der_planner.twin.hardware import draw
from der_planner.twin.truth import known_values

Figures = dict[str, float | str]

AMPLITUDE = 16_800.0
"""Largest differential pressure of the calibration runs [Pa]."""
FRESH_SEEDS = (101, 102, 103, 104, 105)
"""Twins that no setting of the fit was chosen on."""
LADDER: tuple[tuple[str, ...], ...] = (
    (),
    ("asymmetry",),
    ("stiffening", "cubic"),
    ("coupling",),
    ("friction",),
    ("creep",),
    ("dynamics",),
)
"""Model terms in the order in which they are added."""


def _unseen() -> Excitation:
    instants = np.arange(0.0, 40.0, PERIOD)
    waves = [1.0 - np.cos(instants / 3.0), np.sin(instants / 2.0)]
    return Excitation(instants, 9000.0 * np.stack(waves, axis=1), ())


def _fitted(log: CalibrationLog, terms: Iterable[str] = GROUPS) -> tuple[Limb, FitReport, float]:
    begin = time.process_time()
    limb, report = fit(Limb.default(), log, terms=terms)
    return limb, report, time.process_time() - begin


def _tip_error(limb: Limb, log: CalibrationLog, model: str) -> NDArray[np.float64]:
    """Return the open-loop error of the tip (K,) over the limb's length."""
    tip = predict(limb, log.time, log.measured_differential, model).tip
    error: NDArray[np.float64] = np.linalg.norm(tip - log.tip, axis=1) / limb.length
    return error


def run(quick: bool) -> Figures:
    """Measure; prints tables and returns every figure."""
    seeds = FRESH_SEEDS[:2] if quick else FRESH_SEEDS
    logs = {seed: record_twin(seed, calibration_run(AMPLITUDE, quick=quick)) for seed in seeds}
    unseen = {seed: record_twin(seed, _unseen(), run=2) for seed in seeds}
    figures = _time(logs[seeds[0]], quick)
    fits = {seed: _fitted(log) for seed, log in logs.items()}
    figures |= _recovery({seed: report for seed, (_, report, _) in fits.items()})
    figures |= _prediction({seed: limb for seed, (limb, _, _) in fits.items()}, unseen)
    return figures | _terms(logs, unseen)


def _time(log: CalibrationLog, quick: bool) -> Figures:
    figures: Figures = {}
    print("fit: length of the log [s], processor time [s]")
    for length in (43.0, 86.0) if quick else (50.0, 100.0, 198.0):
        _, _, seconds = _fitted(log.between(0.0, length))
        figures[f"fit_of_{length:.0f}s_log_cpu_s"] = seconds
        print(f"  {length:6.0f}  {seconds:6.2f}", flush=True)
    return figures


def _recovery(reports: dict[int, FitReport]) -> Figures:
    """Compare what was found with what the seeds drew, in stated standard deviations."""
    distances: dict[str, list[float]] = {}
    for seed, report in reports.items():
        for name, known in known_values(draw(seed)).items():
            found = report.value(name)
            deviation = float(np.hypot(found.deviation, known.spread))
            term = name.split("[", maxsplit=1)[0]
            distances.setdefault(term, []).append((found.value - known.value) / deviation)
    print("known parameters: error in stated standard deviations, root mean square (largest)")
    figures: Figures = {}
    for term, values in distances.items():
        figures[f"recovery_{term}_rms_deviations"] = float(np.sqrt(np.mean(np.square(values))))
        figures[f"recovery_{term}_largest_deviations"] = float(np.abs(values).max())
        print(
            f"  {term:22s} {figures[f'recovery_{term}_rms_deviations']:5.2f} "
            f"({figures[f'recovery_{term}_largest_deviations']:.2f})"
        )
    together = np.abs(np.concatenate(list(distances.values())))
    for bound in (1, 2, 3):
        share = 100.0 * float(np.mean(together < bound))
        figures[f"recovery_within_{bound}_deviations_percent"] = share
        print(f"  within {bound} deviations: {share:.0f} % of {together.size}", flush=True)
    return figures


def _prediction(limbs: dict[int, Limb], unseen: dict[int, CalibrationLog]) -> Figures:
    figures: Figures = {}
    print("unseen motion, tip error in % of the limb's length: mean (max)")
    print("  seed   DER            PCC            not calibrated")
    for seed, limb in limbs.items():
        cells = []
        for name, robot, model in (
            ("der", limb, "der"),
            ("pcc", limb, "pcc"),
            ("uncalibrated", Limb.default(), "der"),
        ):
            error = 100.0 * _tip_error(robot, unseen[seed], model)
            figures[f"seed_{seed}_{name}_mean_percent"] = float(error.mean())
            figures[f"seed_{seed}_{name}_max_percent"] = float(error.max())
            cells.append(f"{error.mean():5.2f} ({error.max():5.2f})")
        print(f"  {seed:4d}  {'  '.join(cells)}", flush=True)
    return figures


def _terms(logs: dict[int, CalibrationLog], unseen: dict[int, CalibrationLog]) -> Figures:
    figures: Figures = {}
    print("what each term buys: bend angle left at the calibration, unseen tip, means of the seeds")
    print(f"  {'terms':24s} fit [deg]  mean [%]  max [%]")
    terms: tuple[str, ...] = ()
    for added in LADDER:
        terms += added
        rows = []
        for seed, log in logs.items():
            limb, report, _ = _fitted(log, terms)
            error = 100.0 * _tip_error(limb, unseen[seed], "der")
            rows.append((np.degrees(report.residual).mean(), error.mean(), error.max()))
        left, mean, largest = np.mean(rows, axis=0)
        key = "_".join(added) or "linear"
        figures[f"terms_to_{key}_fit_deg"] = float(left)
        figures[f"terms_to_{key}_mean_percent"] = float(mean)
        figures[f"terms_to_{key}_max_percent"] = float(largest)
        label = "+ " + ", ".join(added) if added else "gain, rest angle"
        print(f"  {label:24s} {left:9.2f} {mean:9.2f} {largest:8.2f}", flush=True)
    return figures
