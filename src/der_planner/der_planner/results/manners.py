"""One motion played blind, with feedback, learned, and learned with feedback, side by side."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from der_planner.results import style
from der_planner.results.figures import new_figure
from der_planner.results.html import table
from der_planner.results.learning import learned_from
from der_planner.results.metrics import RunResult
from der_planner.results.table import CASE

FEEDBACK = "feedback"
"""What stands behind the + in the method of a plan that was corrected."""
MANNERS = ("open_loop", "feedback", "learned", "learned_feedback")
"""Keys of `side_by_side`."""
_HEADS = ("open loop", "feedback", "learned", "learned + feedback")
_MILLISECONDS = 1e3


def manner(method: str) -> str:
    """Return which of `MANNERS` a run's method belongs to."""
    learned = "learned" if learned_from(method) else ""
    corrected = method.partition("+")[2].strip() == FEEDBACK
    return "_".join([learned] * bool(learned) + [FEEDBACK] * corrected) or "open_loop"


def side_by_side(results: Sequence[RunResult]) -> list[dict[str, Any]]:
    """Return by limb, motion and model the mean errors [m] of each manner; None: not played.

    Of learned runs those count whose plan was learned from the most runs.
    """
    rows: dict[tuple[str, str, str], dict[str, dict[int, list[float]]]] = {}
    for run in results:
        row = rows.setdefault((run.namespace, run.motion, run.model), {})
        by_count = row.setdefault(manner(run.method), {})
        by_count.setdefault(learned_from(run.method), []).append(run.mean_error_m)
    return [
        {
            "namespace": namespace,
            "motion": motion,
            "model": model,
            **{
                f"{name}_m": float(np.mean(row[name][max(row[name])])) if name in row else None
                for name in MANNERS
            },
        }
        for (namespace, motion, model), row in rows.items()
        if len(row) > 1
    ]


def manners_table(results: Sequence[RunResult]) -> str:
    """Return the table of `side_by_side` in cm; empty where every motion has one manner only."""
    rows = side_by_side(results)
    if not rows:
        return ""
    lines = [
        [
            html.escape(CASE.get(row["motion"], row["motion"])),
            html.escape(row["model"].upper()),
            *(
                "–" if row[f"{name}_m"] is None else f"{row[f'{name}_m'] * 100:.3f}"
                for name in MANNERS
            ),
        ]
        for row in rows
    ]
    header = ["case", "model", *(f"{head}, E [cm]" for head in _HEADS)]
    return "<h2>Open loop, feedback, learning</h2>" + table(header, lines, names=2)


def plot_latency(
    results: Sequence[RunResult], folder: Path, formats: tuple[str, ...] = ("png", "pdf")
) -> list[Path]:
    """Draw the time from a picture to the first setpoint corrected by it, where it is known.

    Args:
        results: of an experiment; all runs with feedback are counted together.
        folder: where ``latency.png`` and ``latency.pdf`` go.
        formats: file name endings.
    """
    told = [run.extra.get("feedback", {}) for run in results]
    counted = [about for about in told if about.get("latency_counts")]
    if not counted:
        return []
    counts = np.sum([about["latency_counts"] for about in counted], axis=0)
    width = float(counted[0]["latency_bin_s"]) * _MILLISECONDS
    with style.paper_style():
        figure: Any = new_figure(style.COLUMN, 2.0)
        axis = figure.subplots()
        last = int(np.nonzero(counts)[0][-1]) + 2
        axis.bar(np.arange(len(counts))[:last] * width, counts[:last], width, align="edge")
        axis.set(xlabel="from picture to board [ms]", ylabel="pictures")
        return style.save(figure, folder, "latency", formats)
