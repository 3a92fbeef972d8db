"""The learning curve: mean tip error over the runs that a plan was learned from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from der_planner.methods import LEARNED
from der_planner.results import style
from der_planner.results.figures import new_figure
from der_planner.results.metrics import RunResult

CM = 100.0


def learned_from(method: str) -> int:
    """Return how many runs a method's plan was learned from: 0 for a first plan."""
    name, count, *_ = [*method.split(), "", ""]
    return int(count) if name == LEARNED and count.isdigit() else 0


def learning_curves(results: Sequence[RunResult]) -> dict[str, list[list[float]]]:
    """Return by motion the mean errors [m] of each trial's runs, in the order of learning.

    Trials that were not learned from are left out.
    """
    trials: dict[tuple[str, str, int, str], dict[int, float]] = {}
    for result in results:
        # "learned 2 + feedback": what was played beside the plan makes a curve of its own.
        beside = result.method.partition("+")[2]
        key = (result.motion, result.model, result.trial, beside)
        trials.setdefault(key, {})[learned_from(result.method)] = result.mean_error_m
    curves: dict[str, list[list[float]]] = {}
    for (motion, *_), errors in trials.items():
        if max(errors) > 0 and 0 in errors:
            curves.setdefault(motion, []).append([errors[k] for k in sorted(errors)])
    return curves


def plot_learning(
    results: Sequence[RunResult], folder: Path, formats: tuple[str, ...] = ("png", "pdf")
) -> list[Path]:
    """Draw the learning curves, a line a trial and a column a motion; nothing where there is none.

    Args:
        results: of an experiment.
        folder: where ``learning.png`` and ``learning.pdf`` go.
        formats: file name endings.
    """
    curves = learning_curves(results)
    if not curves:
        return []
    with style.paper_style():
        figure: Any = new_figure(style.PAGE if len(curves) > 1 else style.COLUMN, 2.2)
        axes = figure.subplots(1, len(curves), squeeze=False, sharey=True)[0]
        for axis, (motion, trials) in zip(axes, curves.items(), strict=True):
            for errors in trials:
                axis.semilogy(np.arange(len(errors)), np.array(errors) * CM, "o-", ms=3)
            axis.set(xlabel="runs learned from", title=motion.replace("_", " "))
            axis.xaxis.get_major_locator().set_params(integer=True)
        axes[0].set_ylabel("mean tip error [cm]")
        return style.save(figure, folder, "learning", formats)
