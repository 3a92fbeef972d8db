"""Over trials: mean, deviation, and whether one model is better than another.

Only runs that can be compared are compared; the others are left out and the reason is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from der_planner.arrays import Array
from der_planner.methods import LEARNED
from der_planner.results.evaluation import RunResult

RESAMPLES = 10_000
CONFIDENCE = 0.95
SEED = 20260
SAME_REFERENCE = 1e-4
"""References nearer than that [m] are the same."""
FEEDBACK = "feedback"
"""What stands behind the + in the method of a plan that was corrected."""
CONTROLS = ("open_loop", "feedback", "learned", "learned_feedback")
"""Ways of playing a motion that `side_by_side` compares."""


@dataclass(frozen=True)
class Summary:
    """One row of the table: mean and standard deviation over trials [m].

    ``std_…`` is the sample standard deviation (n − 1) of the trials' values, NaN for one trial.
    """

    motion: str
    model: str
    method: str
    trials: int
    mean_error_m: float
    mean_error_x_m: float
    mean_error_y_m: float
    std_error_m: float
    std_error_x_m: float
    std_error_y_m: float
    max_error_m: float
    valid_fraction: float
    predicted_error_m: float
    problems: tuple[str, ...] = ()
    namespace: str = ""
    loads: str = ""


@dataclass(frozen=True)
class Comparison:
    """Mean error of the baseline minus that of a model on one motion.

    Attributes:
        motion: of both.
        model, baseline: with their methods, e.g. ``der optimal``.
        difference_m: positive where the model is better [m]; NaN where refused.
        low_m, high_m: bootstrap interval of `CONFIDENCE` [m]; NaN with fewer than two trials.
        paired: trials were paired by seed.
        trials: (of the model, of the baseline).
        refused: why there is no figure; empty where there is one.
        namespace: of the limb, where the runs are of several; else empty.
        loads: mounting and payload; empty for a horizontal limb without payload.
    """

    motion: str
    model: str
    baseline: str
    difference_m: float = float("nan")
    low_m: float = float("nan")
    high_m: float = float("nan")
    paired: bool = False
    trials: tuple[int, int] = (0, 0)
    refused: str = ""
    namespace: str = ""
    loads: str = ""


Key = tuple[str, str, str, str, str]


def group(results: Sequence[RunResult]) -> dict[Key, list[RunResult]]:
    """Return the runs by namespace, loads, motion, model and method, in the order they came.

    The namespace is the same for all where the runs name one only: a run without a bag has none.
    """
    named = sorted({result.namespace for result in results} - {""})
    only = named[0] if len(named) == 1 else ""
    found: dict[Key, list[RunResult]] = {}
    for result in results:
        key = (result.namespace or only, result.loads, result.motion, result.model, result.method)
        found.setdefault(key, []).append(result)
    return found


def summarise(results: Sequence[RunResult]) -> list[Summary]:
    """Return one row per limb, loads, motion, model and method: mean and deviation over trials.

    Runs with problems count as well: they happened. The row names them.
    """
    return [_summary(key, runs) for key, runs in group(results).items()]


def _summary(key: Key, runs: Sequence[RunResult]) -> Summary:
    namespace, loads, motion, model, method = key
    figures = {}
    for axis in ("", "_x", "_y"):
        errors = np.array([getattr(run, f"mean_error{axis}_m") for run in runs])
        figures[f"mean_error{axis}_m"] = float(errors.mean())
        figures[f"std_error{axis}_m"] = float(errors.std(ddof=1)) if len(runs) > 1 else np.nan
    return Summary(
        motion=motion,
        model=model,
        method=method,
        trials=len(runs),
        **figures,
        max_error_m=max(run.max_error_m for run in runs),
        valid_fraction=float(np.mean([run.valid_fraction for run in runs])),
        predicted_error_m=float(np.mean([run.predicted_error_m for run in runs])),
        problems=tuple(f"trial {run.trial}: {text}" for run in runs for text in run.problems),
        namespace=namespace,
        loads=loads,
    )


def compare(results: Sequence[RunResult]) -> list[Comparison]:
    """Compare every model with the baseline ``pcc``: same limb, same loads, same motion.

    Returns:
        One comparison per limb, loads, motion and (model, method) against each baseline method.
        A pair whose runs followed different references, or were not played to the end, is refused.
    """
    groups = group(results)
    several = len({namespace for namespace, *_ in groups}) > 1
    found = []
    for (namespace, loads, motion, model, method), runs in groups.items():
        if model == "pcc":
            continue
        for (*other, other_model, other_method), others in groups.items():
            if other == [namespace, loads, motion] and other_model == "pcc":
                pair = Comparison(
                    motion,
                    f"{model} {method}".strip(),
                    f"{other_model} {other_method}".strip(),
                    trials=(len(runs), len(others)),
                    refused=why_not_comparable([*runs, *others]),
                    namespace=namespace if several else "",
                    loads=loads,
                )
                found.append(pair if pair.refused else _compared(pair, runs, others))
    return found


def why_not_comparable(results: Sequence[RunResult]) -> str:
    """Say why runs of one motion must not be compared; empty if they may."""
    for run in results:
        if run.problems:
            return f"{run.bag or run.motion} (trial {run.trial}): {'; '.join(run.problems)}"
    windows = {(round(run.window_s[0], 3), round(run.window_s[1], 3)) for run in results}
    if len(windows) > 1:
        return f"different windows: {', '.join(f'{a:g} to {b:g} s' for a, b in sorted(windows))}"
    apart = _references_apart(results)
    if apart > SAME_REFERENCE:
        return f"the tip references are up to {apart * 1000:.1f} mm apart"
    return ""


def _references_apart(results: Sequence[RunResult]) -> float:
    """Return the largest distance between references that ought to be the same [m].

    A plan starts where the vented limb rests, so trials on differently drawn twins lead in from
    different places: there each trial is compared with itself. Runs that share no trial must agree.
    """
    groups: dict[tuple[int, int], list[Array]] = {}
    for run in results:
        if run.reference_points_m:
            path = np.array(run.reference_points_m)
            groups.setdefault((run.trial, run.seed), []).append(path)
    sets = list(groups.values())
    if not any(len(paths) > 1 for paths in sets):
        sets = [[path for paths in sets for path in paths]]
    gaps = [float(np.abs(path - paths[0]).max()) for paths in sets for path in paths[1:]]
    return max(gaps, default=0.0)


def _compared(pair: Comparison, runs: list[RunResult], others: list[RunResult]) -> Comparison:
    """Return a comparison with its figures."""
    one, two = (np.array([run.mean_error_m for run in side]) for side in (runs, others))
    differences = _pairs(runs, others)
    low, high = _interval(two, one) if differences is None else _interval(differences)
    return replace(
        pair,
        difference_m=float(two.mean() - one.mean()),
        low_m=low,
        high_m=high,
        paired=differences is not None,
    )


def _pairs(one: list[RunResult], two: list[RunResult]) -> Array | None:
    """Return baseline minus model for every seed, if both have the same seeds, each once."""
    first = {run.seed: run.mean_error_m for run in one}
    second = {run.seed: run.mean_error_m for run in two}
    same = first.keys() == second.keys() and len(first) == len(one) == len(two)
    if not same or -1 in first:
        return None
    return np.array([second[seed] - first[seed] for seed in sorted(first)])


def _interval(*samples: Array) -> tuple[float, float]:
    """Return the percentile bootstrap interval of a mean, or of a difference of means [m].

    NaN where a sample has fewer than two values. The seed is fixed: the same runs give the same
    interval.

    Args:
        samples: of differences; or two drawn independently, of the baseline and of the model.
    """
    if min(len(sample) for sample in samples) < 2:
        return float("nan"), float("nan")
    random = np.random.default_rng(SEED)
    means = [
        random.choice(sample, size=(RESAMPLES, len(sample))).mean(axis=1) for sample in samples
    ]
    resampled = means[0] if len(means) == 1 else means[0] - means[1]
    low, high = np.quantile(resampled, [0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2])
    return float(low), float(high)


def learned_from(method: str) -> int:
    """Return how many runs a method's plan was learned from: 0 for a first plan."""
    name, count, *_ = [*method.split(), "", ""]
    return int(count) if name == LEARNED and count.isdigit() else 0


def learning_curves(results: Sequence[RunResult]) -> dict[str, list[tuple[str, list[float]]]]:
    """Return by motion the model and mean errors [m] of each trial's runs, in their order.

    Trials that were not learned from are left out.
    """
    trials: dict[tuple[Any, ...], dict[int, float]] = {}
    for (namespace, loads, motion, model, method), runs in group(results).items():
        for run in runs:
            # "learned 2 + feedback": what was played beside the plan makes a curve of its own.
            beside = method.partition("+")[2]
            key = (motion, model, namespace, loads, run.trial, run.seed, beside)
            trials.setdefault(key, {})[learned_from(method)] = run.mean_error_m
    curves: dict[str, list[tuple[str, list[float]]]] = {}
    for (motion, model, *_), errors in trials.items():
        if max(errors) > 0 and 0 in errors:
            curves.setdefault(motion, []).append((model, [errors[k] for k in sorted(errors)]))
    return curves


def control_of(method: str) -> str:
    """Return which of `CONTROLS` a run's method belongs to."""
    corrected = method.partition("+")[2].strip() == FEEDBACK
    return CONTROLS[2 * (learned_from(method) > 0) + corrected]


def side_by_side(results: Sequence[RunResult]) -> list[dict[str, Any]]:
    """Return by limb, loads, motion and model the mean error [m] of each of `CONTROLS`.

    Of learned runs those count whose plan was learned from the most runs; None: not played.
    """
    rows: dict[tuple[str, ...], dict[str, dict[int, list[float]]]] = {}
    for (*which, method), runs in group(results).items():
        by_count = rows.setdefault(tuple(which), {}).setdefault(control_of(method), {})
        by_count.setdefault(learned_from(method), []).extend(run.mean_error_m for run in runs)
    names = ("namespace", "loads", "motion", "model")
    return [
        dict(zip(names, which, strict=True))
        | {
            f"{name}_m": float(np.mean(row[name][max(row[name])])) if name in row else None
            for name in CONTROLS
        }
        for which, row in rows.items()
        if len(row) > 1
    ]
