"""Time of a fit, and what each term of the model is worth.

What a fit recovers and how well it predicts: ``python3 scripts/study.py identification``.
"""

from __future__ import annotations

import time
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from benchmarks import show
from der_planner.identification import CalibrationLog, FitReport, fit, predict, record_twin
from der_planner.identification.excitation import calibration_run
from der_planner.identification.terms import GROUPS
from der_planner.limb import Limb
from der_planner.studies.tasks import UNSEEN_RUN, unseen_motion

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


def _fitted(log: CalibrationLog, terms: Iterable[str] = GROUPS) -> tuple[Limb, FitReport, float]:
    begin = time.process_time()
    limb, report = fit(Limb.default(), log, terms=terms)
    return limb, report, time.process_time() - begin


def _tip_error(limb: Limb, log: CalibrationLog) -> NDArray[np.float64]:
    """Return the open-loop error of the tip (K,) over the limb's length."""
    tip = predict(limb, log.time, log.measured_differential).tip
    error: NDArray[np.float64] = np.linalg.norm(tip - log.tip, axis=1) / limb.length
    return error


def run(quick: bool) -> Figures:
    """Measure; prints tables and returns every figure."""
    seeds = FRESH_SEEDS[:2] if quick else FRESH_SEEDS
    logs = {seed: record_twin(seed, calibration_run(AMPLITUDE, quick=quick)) for seed in seeds}
    unseen = {seed: record_twin(seed, unseen_motion(), run=UNSEEN_RUN) for seed in seeds}
    figures = _time(logs[seeds[0]], quick)
    return figures | _terms(logs, unseen)


def _time(log: CalibrationLog, quick: bool) -> Figures:
    figures: Figures = {}
    for length in (43.0, 86.0) if quick else (50.0, 100.0, 198.0):
        _, _, seconds = _fitted(log.between(0.0, length))
        figures[f"fit_of_{length:.0f}s_log_cpu_s"] = seconds
    show(figures)
    return figures


def _terms(logs: dict[int, CalibrationLog], unseen: dict[int, CalibrationLog]) -> Figures:
    """Add term by term: bend angle left at the calibration, unseen tip, means of the seeds."""
    figures: Figures = {}
    terms: tuple[str, ...] = ()
    for added in LADDER:
        terms += added
        rows = []
        for seed, log in logs.items():
            limb, report, _ = _fitted(log, terms)
            error = 100.0 * _tip_error(limb, unseen[seed])
            rows.append((np.degrees(report.residual).mean(), error.mean(), error.max()))
        key = f"terms_to_{'_'.join(added) or 'linear'}"
        names = (f"{key}_fit_deg", f"{key}_mean_percent", f"{key}_max_percent")
        found = dict(zip(names, np.mean(rows, axis=0).tolist(), strict=True))
        show(found)
        figures |= found
    return figures
