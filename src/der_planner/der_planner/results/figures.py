"""Figures of runs in one style. They are drawn without a display, by no global state of pyplot.

The style is that of a two-column paper; its colours are told apart by colour-blind readers.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from der_planner.arrays import Array
from der_planner.bags.run import RunSeries, Stream
from der_planner.results.errors import error_series
from der_planner.results.evaluation import DRAWN, RunResult
from der_planner.results.statistics import learning_curves
from der_planner.results.tables import CASE, CM, several_limbs

FORMATS = ("png", "pdf")
STYLE = Path(__file__).parents[1] / "data" / "paper.mplstyle"
COLUMN = 3.5
"""Width of a column of a two-column paper [inch]."""
PAGE = 7.16
"""Width of both columns [inch]."""
# Okabe and Ito's palette (2008).
REFERENCE = "#000000"
COLOURS = {"der": "#0072B2", "pcc": "#D55E00"}
OTHER = ("#009E73", "#CC79A7", "#E69F00", "#56B4E9")
DASHES = {"der": "-", "pcc": "--"}


def colour(model: str, index: int = 0) -> str:
    """Return the colour of a model, or the index-th of the rest for an unknown one."""
    return COLOURS.get(model, OTHER[index % len(OTHER)])


def label_of(run: RunSeries) -> str:
    """Return model and method of a run, which its trials share."""
    about = run.description
    return f"{about.model.upper()} ({about.method})" if about.method else about.model.upper()


def colours_of(runs: Sequence[RunSeries]) -> dict[str, tuple[float, ...]]:
    """Return the colour of each label: the model's own, the paler the earlier its method came."""
    models = {label_of(run): run.description.model for run in runs}
    of_model = {
        model: to_rgb(colour(model, i)) for i, model in enumerate(dict.fromkeys(models.values()))
    }
    found = {}
    for label, model in models.items():
        same = [each for each, other in models.items() if other == model]
        share = (same.index(label) + 1.0) / len(same)
        found[label] = tuple(1.0 - (0.3 + 0.7 * share) * (1.0 - part) for part in of_model[model])
    return found


def paper_style() -> AbstractContextManager[None]:
    """Set font sizes and line widths of a two-column paper, without touching the caller's."""
    return style.context(STYLE)


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure in each of `FORMATS` and return the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for suffix in FORMATS:
        path = folder / f"{name}.{suffix}"
        # Without a date in it, the same runs give the same file.
        stripped = {"CreationDate": None} if suffix == "pdf" else None
        figure.savefig(path, metadata=stripped)
        paths.append(path)
    return paths


def shared_legend(figure: Figure, axes: Iterable[Axes]) -> None:
    """Put one legend above all axes, in which each label stands once."""
    handles = {
        label: handle
        for axis in axes
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    # A handle with its gaps takes half an inch, a letter of the legend's font less than 0.06 inch.
    widest = 0.5 + 0.06 * max(map(len, handles), default=0)
    columns = max(1, int(figure.get_figwidth() / widest))
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=columns)


def by_motion(runs: Sequence[RunSeries]) -> dict[str, list[RunSeries]]:
    """Return the runs of each motion, and of each limb where there are several, by their title."""
    several = several_limbs(run.description.namespace for run in runs)
    found: dict[str, list[RunSeries]] = {}
    for run in runs:
        about = run.description
        title = f"Case {CASE[about.motion]}" if about.motion in CASE else about.motion
        if several:
            title += f", {about.namespace}"
        found.setdefault(title, []).append(run)
    return found


def plot_tip(runs: Sequence[RunSeries], folder: Path) -> list[Path]:
    """Draw tip against reference, a row per motion: the path, and x, y over time.

    Args:
        runs: any number, of any motions and models.
        folder: where ``tip.png`` and ``tip.pdf`` go.

    Returns:
        The written files.
    """
    motions = by_motion(runs)
    with paper_style():
        figure = Figure(figsize=(PAGE, 2.1 * len(motions)))
        axes = figure.subplots(len(motions), 3, squeeze=False)
        for row, (title, members) in zip(axes, motions.items(), strict=True):
            _draw_tip_row(row, title, members)
        shared_legend(figure, [axes[0][0]])
        return save(figure, folder, "tip")


def _draw_tip_row(row: Sequence[Axes], title: str, runs: Sequence[RunSeries]) -> None:
    plane, over_x, over_y = row

    def draw(series: Stream, label: str, look: dict[str, Any]) -> None:
        x, y = series.value.T * CM
        plane.plot(x, y, label=label, **look)
        over_x.plot(series.time, x, **look)
        over_y.plot(series.time, y, **look)

    colours = colours_of(runs)
    for run in runs:
        label = label_of(run)
        look = {
            "color": colours[label],
            "alpha": 0.9 if len(runs) <= 4 * len(colours) else 0.5,
            "lw": 1.0,
            "ls": DASHES.get(run.description.model, "-."),
        }
        draw(run.tip.between(0.0, run.reference.time[-1]), label, look)
    if drawn := runs[0].description.extra.get(DRAWN):
        plane.plot(*np.transpose(drawn) * CM, label="drawn", color="0.6", ls=":")
    draw(runs[0].reference, "reference", {"color": REFERENCE, "lw": 0.9, "ls": ":"})
    plane.set_aspect("equal", adjustable="datalim")
    plane.set(xlabel="x [cm]", ylabel="y [cm]", title=title)
    over_x.set(xlabel="time [s]", ylabel="x [cm]")
    over_y.set(xlabel="time [s]", ylabel="y [cm]")


def plot_error(runs: Sequence[RunSeries], folder: Path) -> list[Path]:
    """Draw the tip error over time: mean and one standard deviation over trials per model.

    Args:
        runs: any number; a column per motion.
        folder: where ``error.png`` and ``error.pdf`` go.
    """
    motions = by_motion(runs)
    with paper_style():
        wide = PAGE if len(motions) > 1 else COLUMN
        figure = Figure(figsize=(wide, 2.2))
        axes = figure.subplots(1, len(motions), squeeze=False, sharey=True)[0]
        for axis, (title, members) in zip(axes, motions.items(), strict=True):
            for label, look in colours_of(members).items():
                same = [run for run in members if label_of(run) == label]
                time, mean, deviation = mean_error(same)
                dash = DASHES.get(same[0].description.model, "-.")
                axis.plot(time, mean * CM, color=look, ls=dash, label=label)
                low = np.maximum(mean - deviation, 0.0)
                axis.fill_between(
                    time, low * CM, (mean + deviation) * CM, color=look, alpha=0.2, lw=0
                )
            axis.set(xlabel="time [s]", title=title)
            axis.set_ylim(bottom=0.0)
        axes[0].set_ylabel("tip error [cm]")
        shared_legend(figure, axes)
        return save(figure, folder, "error")


def mean_error(runs: Sequence[RunSeries]) -> tuple[Array, Array, Array]:
    """Return time, mean and standard deviation of |r − r̄| over runs on a common grid [s, m, m].

    A gap in one run does not count there: at each instant the mean is over the runs that have a
    valid image within 0.1 s. The deviation is 0 where only one has.
    """
    grid = np.arange(0.0, min(float(run.reference.time[-1]) for run in runs), 0.05)
    rows = np.full((len(runs), len(grid)), np.nan)
    for row, run in zip(rows, runs, strict=True):
        series = error_series(run)
        row[:] = np.interp(grid, series.time, np.linalg.norm(series.value, axis=1))
        nearest = np.searchsorted(series.time, grid).clip(1, len(series.time) - 1)
        away = np.minimum(
            np.abs(grid - series.time[nearest - 1]), np.abs(series.time[nearest] - grid)
        )
        row[away > 0.1] = np.nan
    keep = np.isfinite(rows).any(axis=0)
    known = np.ma.masked_invalid(rows[:, keep])
    deviation = known.std(axis=0, ddof=1) if len(runs) > 1 else np.zeros(known.shape[1])
    return grid[keep], np.asarray(known.mean(axis=0)), np.ma.filled(deviation, 0.0)


def plot_pressures(runs: Sequence[RunSeries], folder: Path) -> list[Path]:
    """Draw commanded and measured differential pressures, a row per motion, a column per segment.

    The first run of each model stands for its trials. Returns nothing where no run has pressures.
    """
    runs = [run for run in runs if len(run.commanded)]
    if not runs:
        return []
    motions = by_motion(runs)
    segments = max(run.commanded.value.shape[1] for run in runs)
    with paper_style():
        figure = Figure(figsize=(PAGE, 1.9 * len(motions)))
        axes = figure.subplots(len(motions), segments, squeeze=False, sharex="row")
        for row, (title, members) in zip(axes, motions.items(), strict=True):
            for label, look in colours_of(members).items():
                _draw_pressures(row, next(run for run in members if label_of(run) == label), look)
            for segment, axis in enumerate(row):
                axis.set(xlabel="time [s]", ylabel=f"Δp, segment {segment} [kPa]")
            row[0].set_title(title)
        shared_legend(figure, [axes[0][0]])
        return save(figure, folder, "pressures")


def _draw_pressures(row: Sequence[Axes], run: RunSeries, look: tuple[float, ...]) -> None:
    kinds: tuple[tuple[str, dict[str, Any]], ...] = (
        ("commanded", {"ls": ":", "lw": 0.9, "label": "commanded"}),
        ("measured", {"ls": DASHES.get(run.description.model, "-."), "label": label_of(run)}),
    )
    for name, drawn in kinds:
        stream = getattr(run, name).between(0.0, run.reference.time[-1])
        for axis, pressure in zip(row, stream.value.T if len(stream) else (), strict=False):
            axis.plot(stream.time, pressure / 1000.0, color=look, **drawn)


def plot_learning(results: Sequence[RunResult], folder: Path) -> list[Path]:
    """Draw the learning curves, a line a trial and a column a motion; nothing where there is none.

    Args:
        results: of an experiment.
        folder: where ``learning.png`` and ``learning.pdf`` go.
    """
    curves = learning_curves(results)
    if not curves:
        return []
    with paper_style():
        figure: Any = Figure(figsize=(PAGE if len(curves) > 1 else COLUMN, 2.2))
        axes = figure.subplots(1, len(curves), squeeze=False, sharey=True)[0]
        for axis, (motion, trials) in zip(axes, curves.items(), strict=True):
            for model, errors in trials:
                drawn = {"color": colour(model), "ls": DASHES.get(model, "-."), "marker": "o"}
                values = np.array(errors) * CM
                axis.semilogy(np.arange(len(errors)), values, ms=3, label=model.upper(), **drawn)
            axis.set(xlabel="runs learned from", title=motion.replace("_", " "))
            axis.xaxis.get_major_locator().set_params(integer=True)
            axis.yaxis.set_major_formatter("{x:g}")
            axis.yaxis.set_minor_formatter("{x:.2g}")
        axes[0].set_ylabel("mean tip error [cm]")
        shared_legend(figure, axes)
        return save(figure, folder, "learning")
