"""Figures of a study, as its file asks for them, in the style of the experiments' figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from der_planner.arrays import Array
from der_planner.results import figures as style
from der_planner.results.figures import new_figure
from der_planner.studies.store import Kept
from der_planner.studies.study import Study

Records = Sequence[Kept]
_UNITS = {"_m": ("cm", 100.0), "_pa": ("kPa", 1e-3), "_rad": ("°", 180.0 / np.pi)}
_HEIGHT = 2.3
CONFIDENCE = 0.95
"""The intervals of Sobol indices hold the true value with this probability."""
_RESAMPLES = 500
"""Those intervals come from this many resamplings of the rows."""


def quantity(name: str, study: Study) -> tuple[str, float]:
    """Return the label of a column as people read it, and the factor from its SI unit."""
    for ending, (unit, factor) in _UNITS.items():
        if name in study.keep and name.endswith(ending):
            return f"{name.removesuffix(ending).replace('_', ' ')} [{unit}]", factor
    declared = study.factors.get(name)
    if declared is None or declared.unit == "-":
        return name.replace("_", " "), 1.0
    if declared.unit == "rad":
        return f"{name.replace('_', ' ')} [°]", 180.0 / np.pi
    return f"{name.replace('_', ' ')} [{declared.unit}]", 1.0


def draw(study: Study, kept: Mapping[str, Kept], folder: Path) -> dict[str, list[Path]]:
    """Draw every figure of a study from its rows without errors.

    Args:
        study: its `plots` say what.
        kept: rows that are done, by key.
        folder: where NAME.png and NAME.pdf go.

    Returns:
        The files of each figure by its name; a figure without rows is left out.
    """
    good = [each for each in kept.values() if each["error"] is None]
    written: dict[str, list[Path]] = {}
    for plot in study.plots:
        used = [plot[key] for key in ("x", "y", "value", "of") if key in plot]
        rows = [each for each in good if all(each[name] is not None for name in used)]
        indices = sobol_indices(study, kept, plot["of"]) if plot["kind"] == "indices" else ()
        if not rows or (plot["kind"] == "indices" and not indices):
            continue
        with style.paper_style():
            figure = _indices(plot, indices) if indices else _panels(study, plot, rows)
            written[plot["name"]] = style.save(figure, folder, plot["name"])
    return written


def _panels(study: Study, plot: Mapping[str, str], rows: Records) -> Figure:
    """Return a figure with one panel for each value of the factor ``panels``."""
    by = plot.get("panels")
    values: list[Any] = sorted({each[by] for each in rows}, key=_order) if by else [""]
    width = style.PAGE if len(values) > 1 else style.COLUMN
    figure = new_figure(width, _HEIGHT)
    axes = figure.subplots(1, len(values), squeeze=False, sharey=plot["kind"] != "map")[0]
    fill: Callable[[Study, Mapping[str, str], Records, Axes], None] = _KINDS[plot["kind"]]
    for place, (value, panel) in enumerate(zip(values, axes, strict=True)):
        fill(study, plot, [each for each in rows if not by or each[by] == value], panel)
        if by:
            label, factor = quantity(by, study)
            panel.set_title(f"{label}: {value * factor:.3g}" if _number(value) else str(value))
        if place and plot["kind"] != "map":
            panel.set_ylabel("")
            if panel.get_legend() is not None:
                panel.get_legend().remove()
    # Panels share their axis: where it ends is known when all are drawn.
    for panel in axes:
        for axis in plot.get("log", ""):
            (panel.set_xscale if axis == "x" else panel.set_yscale)("log")
        if plot["kind"] == "lines" and "y" not in plot.get("log", ""):
            panel.set_ylim(bottom=0.0)
        if "x" in plot.get("log", ""):
            ticks = sorted({each[plot["x"]] * quantity(plot["x"], study)[1] for each in rows})
            panel.set_xticks(ticks, [f"{tick:.3g}" for tick in ticks], minor=False)
            panel.set_xticks([], minor=True)
        if "y" in plot.get("log", ""):
            panel.yaxis.set_major_formatter("{x:g}")
    if plot.get("title"):
        figure.suptitle(plot["title"])
    return figure


def _lines(study: Study, plot: Mapping[str, str], rows: Records, panel: Axes) -> None:
    """Draw the mean of y over x, one line for each value of ``lines``, ± a standard deviation."""
    (x_label, x_factor), (y_label, y_factor) = (quantity(plot[key], study) for key in ("x", "y"))
    by = plot.get("lines")
    names = [] if _number(rows[0][plot["x"]]) else sorted({each[plot["x"]] for each in rows})
    for place, value in enumerate(sorted({each[by] for each in rows}, key=_order) if by else [""]):
        mine = [each for each in rows if not by or each[by] == value]
        at, mean, deviation = spread_over(mine, plot["x"], plot["y"])
        x = np.array([names.index(name) if names else name for name in at], dtype=float)
        look: dict[str, Any] = {"color": style.colour(str(value), place)}
        label = value.upper() if by == "model" else f"{by} {value}" if by else None
        panel.plot(
            x * x_factor, mean * y_factor, "o" + style.DASHES.get(str(value), "-"), ms=3,
            label=label, **look,
        )  # fmt: skip
        low, high = (mean - deviation) * y_factor, (mean + deviation) * y_factor
        panel.fill_between(x * x_factor, low, high, alpha=0.18, lw=0, **look)
    panel.set(xlabel=x_label, ylabel=y_label)
    if names:
        panel.set_xticks(range(len(names)), names, rotation=30, ha="right")
    if by:
        panel.legend()


def spread_over(rows: Records, x: str, y: str) -> tuple[list[Any], Array, Array]:
    """Return the values of x, and mean and standard deviation of y at each of them."""
    places = sorted({each[x] for each in rows}, key=_order)
    groups = [np.array([each[y] for each in rows if each[x] == place]) for place in places]
    deviation = [group.std(ddof=1) if len(group) > 1 else 0.0 for group in groups]
    return places, np.array([group.mean() for group in groups]), np.array(deviation)


def _map(study: Study, plot: Mapping[str, str], rows: Records, panel: Axes) -> None:
    """Draw the mean of a value over two factors; with ``per``, as a ratio of its two values."""
    (x_label, x_factor), (y_label, y_factor) = (quantity(plot[key], study) for key in ("x", "y"))
    label, factor = quantity(plot["value"], study)
    xs = sorted({each[plot["x"]] for each in rows})
    ys = sorted({each[plot["y"]] for each in rows})
    per = plot.get("per")
    sides = sorted({each[per] for each in rows}, key=_order)[:2] if per else [None]
    tables = [_means(plot, [r for r in rows if not per or r[per] == s], xs, ys) for s in sides]
    table = tables[0] * factor
    if len(tables) == 2:
        table, label = tables[1] / tables[0], f"{sides[1]} over {sides[0]}"
    image = panel.imshow(table, origin="lower", aspect="auto", cmap="cividis")
    for row, column in np.ndindex(table.shape):
        if np.isfinite(table[row, column]):
            panel.text(column, row, f"{table[row, column]:.2f}", ha="center", va="center", size=6,
                       color="white", bbox={"fc": "#00000066", "lw": 0, "pad": 1})  # fmt: skip
    panel.set_xticks(range(len(xs)), [f"{x * x_factor:.3g}" for x in xs])
    panel.set_yticks(range(len(ys)), [f"{y * y_factor:.3g}" for y in ys])
    panel.set(xlabel=x_label, ylabel=y_label)
    panel.figure.colorbar(image, ax=panel, label=label)


def _means(plot: Mapping[str, str], rows: Records, xs: list[Any], ys: list[Any]) -> Array:
    table = np.full((len(ys), len(xs)), np.nan)
    for j, y in enumerate(ys):
        for i, x in enumerate(xs):
            found = [r[plot["value"]] for r in rows if r[plot["x"]] == x and r[plot["y"]] == y]
            if found:
                table[j, i] = np.mean(found)
    return table


def _scatter(study: Study, plot: Mapping[str, str], rows: Records, panel: Axes) -> None:
    (x_label, x_factor), (y_label, y_factor) = (quantity(plot[key], study) for key in ("x", "y"))
    by = plot.get("lines")
    for place, value in enumerate(sorted({each[by] for each in rows}, key=_order) if by else [""]):
        mine = [each for each in rows if not by or each[by] == value]
        panel.plot(
            [each[plot["x"]] * x_factor for each in mine],
            [each[plot["y"]] * y_factor for each in mine],
            ".", ms=3, color=style.colour(str(value), place), label=str(value) if by else None,
        )  # fmt: skip
    panel.set(xlabel=x_label, ylabel=y_label)
    if by:
        panel.legend()


def _histogram(study: Study, plot: Mapping[str, str], rows: Records, panel: Axes) -> None:
    label, factor = quantity(plot["x"], study)
    values = [each[plot["x"]] * factor for each in rows]
    panel.hist(values, bins="auto", color=style.OTHER[3], edgecolor="white", lw=0.4)
    panel.set(xlabel=label, ylabel="rows")


def _indices(plot: Mapping[str, str], indices: Sequence[Index]) -> Figure:
    """Draw first-order and total Sobol indices of every drawn factor, the largest on top."""
    ordered = sorted(indices, key=lambda each: each.total)
    place = np.arange(len(ordered))
    figure = new_figure(style.COLUMN + 1.0, 0.6 + 0.28 * len(ordered))
    panel = figure.subplots()
    for shift, colour, name, label in (
        (0.2, style.COLOURS["der"], "first", "alone"),
        (-0.2, style.OTHER[2], "total", "with what it does together with others"),
    ):
        values = np.array([getattr(each, name) for each in ordered])
        ends = np.array([getattr(each, f"{name}_range") for each in ordered]).T
        panel.barh(
            place + shift, values, 0.38, color=colour, label=label,
            xerr=np.maximum(np.abs(ends - values), 0.0), error_kw={"lw": 0.7},
        )  # fmt: skip
    panel.set_yticks(place, [each.factor.removeprefix("error.") for each in ordered])
    panel.set_xlabel(f"share of the variance of {plot['of'].replace('_', ' ')}")
    panel.legend(loc="lower right")
    return figure


def _number(value: object) -> bool:
    return isinstance(value, (int, float))


def _order(value: object) -> tuple[bool, Any]:
    """Return what sorts numbers among numbers and names among names."""
    return (not _number(value), value)


_KINDS = {"lines": _lines, "map": _map, "scatter": _scatter, "histogram": _histogram}


# Sobol indices ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Index:
    """Of one factor: shares of the variance of a result.

    Attributes:
        first: by this factor alone. total: also together with others.
        first_range, total_range: 95 % interval of each, by resampling the rows.
    """

    factor: str
    first: float
    total: float
    first_range: tuple[float, float]
    total_range: tuple[float, float]


def sobol_indices(study: Study, kept: Mapping[str, Kept], of: str) -> tuple[Index, ...]:
    """Return the Sobol indices of a result, by `scipy.stats.sobol_indices` (Saltelli 2010).

    Empty while rows are missing or where one has failed: the indices need every row.
    """
    if study.draw.method != "saltelli":
        return ()
    rows = [kept.get(row.key) for row in study.rows]
    count, names = study.draw.count, list(study.spreads)
    good = [row[of] for row in rows if row is not None and row[of] is not None]
    if len(good) != count * (len(names) + 2):
        return ()
    values = np.array(good)
    if np.ptp(values) == 0.0:
        return ()
    # It takes most of a second to import: only studies with Sobol indices pay for it.
    import scipy.stats  # noqa: PLC0415

    found = scipy.stats.sobol_indices(
        func={
            "f_A": values[None, :count],
            "f_B": values[None, count : 2 * count],
            "f_AB": values[2 * count :].reshape(len(names), 1, count),
        },
        n=count,
        rng=np.random.default_rng(0),
    )
    spread = found.bootstrap(confidence_level=CONFIDENCE, n_resamples=_RESAMPLES)
    return tuple(
        Index(
            name,
            float(np.ravel(found.first_order)[i]),
            float(np.ravel(found.total_order)[i]),
            _ends(spread.first_order.confidence_interval, i),
            _ends(spread.total_order.confidence_interval, i),
        )
        for i, name in enumerate(names)
    )


def _ends(interval: object, place: int) -> tuple[float, float]:
    low, high = (np.ravel(getattr(interval, name))[place] for name in ("low", "high"))
    return float(low), float(high)
