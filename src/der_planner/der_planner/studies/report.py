"""The end of a study: the table of all rows, the figures that its file asks for, and a page."""

from __future__ import annotations

import html
import itertools
import math
import platform
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from der_planner.arrays import Array
from der_planner.files import write_whole
from der_planner.results import figures as style
from der_planner.results.report import document, figure, section
from der_planner.results.tables import Table
from der_planner.studies.conduct import Kept, Store
from der_planner.studies.study import Study

Records = Sequence[Kept]
CONFIDENCE = 0.95
"""The intervals of Sobol indices hold the true value with this probability."""
_RESAMPLES = 500
"""Those intervals come from this many resamplings of the rows."""
_HEIGHT = 2.3
_MOST_TICKS = 8
_MOST_GROUPS = 60
_MOST_ERRORS = 50
_UNITS = {"_m": ("cm", 100.0), "_pa": ("kPa", 1e-3), "_rad": ("°", 180.0 / np.pi)}
_CAPTIONS = {
    "lines": "{y} over {x}: mean over all other factors, shaded one standard deviation.",
    "scatter": "{y} against {x}, one point a row.",
    "histogram": "How often {x} came out so large.",
    "indices": "Sobol indices of {of}: the share of its variance that each factor explains, with "
    "95 % intervals.",
}


def summarise(study: Study, kept: Mapping[str, Kept], store: Store) -> Path:
    """Write ``rows.csv``, the figures and ``report/report.html``; return the page.

    Raises:
        StudyError: the folder cannot be written.
    """
    store.write_table(kept)
    page = store.folder / "report" / "report.html"
    with store.written():
        write_whole(page, _page(study, kept, draw_all(study, kept, page.parent)))
    return page


def quantity(name: str, study: Study) -> tuple[str, float]:
    """Return the label of a column as people read it, and the factor from its SI unit."""
    for ending, (unit, scale) in _UNITS.items():
        if name in study.keep and name.endswith(ending):
            return f"{name.removesuffix(ending).replace('_', ' ')} [{unit}]", scale
    label, declared = name.replace("_", " "), study.factors.get(name)
    if declared is None or declared.unit == "-":
        return label, 1.0
    if declared.unit == "rad":
        return f"{label} [°]", 180.0 / np.pi
    return f"{label} [{declared.unit}]", 1.0


# Figures -----------------------------------------------------------------------------------------


def draw_all(study: Study, kept: Mapping[str, Kept], folder: Path) -> list[str]:
    """Draw every figure of a study, NAME.png and NAME.pdf, from its rows without errors.

    Returns:
        The figures for the page; one without rows is left out.
    """
    good = [each for each in kept.values() if each["error"] is None]
    pictures = []
    for plot in study.plots:
        used = {key: plot[key] for key in ("x", "y", "of") if key in plot}
        rows = [row for row in good if all(row[name] is not None for name in used.values())]
        with style.paper_style():
            if plot["kind"] == "indices":
                drawn = _indices(plot, sobol_indices(study, kept, plot["of"]))
            else:
                drawn = _panels(study, plot, rows) if rows else None
            if drawn is None:
                continue
            written = style.save(drawn, folder, plot["name"])
        labels = {key: quantity(name, study)[0] for key, name in used.items()}
        caption = plot.get("title") or _CAPTIONS[plot["kind"]].format(**labels)
        pictures += [figure(caption, path) for path in written if path.suffix == ".png"]
    return pictures


def _panels(study: Study, plot: Mapping[str, str], rows: Records) -> Figure:
    """Return a figure with one panel for each value of the factor ``panels``."""
    panels, log = list(_groups(plot.get("panels"), rows)), plot.get("log", "")
    drawn = Figure(figsize=(style.PAGE if len(panels) > 1 else style.COLUMN, _HEIGHT))
    axes = drawn.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    for (value, mine), panel in zip(panels, axes, strict=True):
        (_histogram if plot["kind"] == "histogram" else _lines)(study, plot, mine, panel)
        if "panels" in plot:
            label, scale = quantity(plot["panels"], study)
            panel.set_title(value if isinstance(value, str) else f"{label}: {value * scale:.3g}")
        panel.label_outer()
    if "lines" in plot:
        style.shared_legend(drawn, axes)
    # Panels share their axis: where it ends is known when all are drawn.
    for panel in axes:
        if "x" in log:
            panel.set_xscale("log")
            panel.set_xticks([], minor=True)
        if "y" in log:
            panel.set_yscale("log")
            panel.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            panel.yaxis.set_major_formatter("{x:g}")
            panel.yaxis.set_minor_formatter(NullFormatter())
        elif plot["kind"] == "lines":
            panel.set_ylim(bottom=0.0)
        values = sorted({row[plot["x"]] for row in rows})
        if isinstance(values[0], str):
            panel.tick_params(axis="x", rotation=30)
        elif plot["kind"] == "lines" and len(values) <= _MOST_TICKS:
            scale = quantity(plot["x"], study)[1]
            panel.set_xticks([x * scale for x in values], [f"{x * scale:.3g}" for x in values])
    if plot.get("title"):
        drawn.suptitle(plot["title"])
    return drawn


def _groups(by: str | None, rows: Records) -> Iterator[tuple[Any, Records]]:
    """Yield the rows of each value of a factor; all of them, if there is none."""
    for value in sorted({row[by] for row in rows}) if by else [""]:
        yield value, [row for row in rows if not by or row[by] == value]


def _lines(study: Study, plot: Mapping[str, str], rows: Records, panel: Axes) -> None:
    """Draw the mean of y over x, one line for each value of ``lines``, ± a standard deviation.

    A scatter has a point for each row instead.
    """
    (x_label, x_scale), (y_label, y_scale) = (quantity(plot[key], study) for key in ("x", "y"))
    by = plot.get("lines")
    for place, (value, mine) in enumerate(_groups(by, rows)):
        colour = style.colour(str(value), place)
        label = value.upper() if by == "model" else f"{by} {value}" if by else None
        if plot["kind"] == "scatter":
            x = _scaled([row[plot["x"]] for row in mine], x_scale)
            y = _column(mine, plot["y"]) * y_scale
            panel.plot(x, y, ".", ms=3, color=colour, label=label)
            continue
        groups = [(x, _column(each, plot["y"]) * y_scale) for x, each in _groups(plot["x"], mine)]
        x = _scaled([x for x, _ in groups], x_scale)
        mean = np.array([each.mean() for _, each in groups])
        deviation = np.array([each.std(ddof=1) if len(each) > 1 else 0.0 for _, each in groups])
        dashes = style.DASHES.get(str(value), "-")
        panel.plot(x, mean, "o" + dashes, ms=3, label=label, color=colour)
        panel.fill_between(x, mean - deviation, mean + deviation, alpha=0.18, lw=0, color=colour)
    panel.set(xlabel=x_label, ylabel=y_label)


def _histogram(study: Study, plot: Mapping[str, str], rows: Records, panel: Axes) -> None:
    label, scale = quantity(plot["x"], study)
    values = _column(rows, plot["x"]) * scale
    panel.hist(values, bins="auto", color=style.OTHER[3], edgecolor="white", lw=0.4)
    panel.set(xlabel=label, ylabel="rows")


def _column(rows: Records, name: str) -> Array:
    return np.array([row[name] for row in rows], dtype=np.float64)


def _scaled(values: Sequence[Any], scale: float) -> list[Any]:
    """Return names as they are, and numbers in the unit in which people read them."""
    return [value if isinstance(value, str) else value * scale for value in values]


def _value(name: str, value: Any, study: Study) -> str:
    return value if isinstance(value, str) else f"{value * quantity(name, study)[1]:.4g}"


# Sobol indices -----------------------------------------------------------------------------------


class Index(NamedTuple):
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
    rows = [kept.get(row.key) for row in study.rows]
    count, names = study.draw.count, list(study.spreads)
    values = np.array([row[of] for row in rows if row is not None and row[of] is not None])
    if len(values) != count * (len(names) + 2) or np.ptp(values) == 0.0:
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
    columns = [np.ravel(found.first_order), np.ravel(found.total_order)]
    for each in (spread.first_order, spread.total_order):
        ends = each.confidence_interval
        columns.append(np.column_stack([np.ravel(ends.low), np.ravel(ends.high)]))
    return tuple(
        Index(name, float(first), float(total), tuple(first_range), tuple(total_range))
        for name, first, total, first_range, total_range in zip(names, *columns, strict=True)
    )


def _indices(plot: Mapping[str, str], indices: Sequence[Index]) -> Figure | None:
    """Draw first-order and total Sobol indices of every drawn factor, the largest on top."""
    if not indices:
        return None
    ordered = sorted(indices, key=lambda each: each.total)
    place = np.arange(len(ordered))
    drawn = Figure(figsize=(style.COLUMN + 1.0, 0.6 + 0.28 * len(ordered)))
    panel = drawn.subplots()
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
    named = [f"{e.factor.removeprefix('error.')} ({e.first:.2f}, {e.total:.2f})" for e in ordered]
    panel.set_yticks(place, named)
    panel.set_xlabel(f"share of the variance of {plot['of'].replace('_', ' ')}")
    panel.legend(loc="lower right")
    return drawn


# Tables ------------------------------------------------------------------------------------------


def means_table(study: Study, kept: Mapping[str, Kept]) -> Table:
    """Return mean ± standard deviation of each kept column for each combination of the grid.

    The seed is not a group but what the mean goes over, as is every factor with more values than
    the table could show.
    """
    by = [name for name, values in study.grid.items() if name != "seed" and len(values) > 1]
    while by and math.prod(len(study.grid[name]) for name in by) > _MOST_GROUPS:
        by.remove(max(by, key=lambda name: len(study.grid[name])))
    good = [row for row in kept.values() if row["error"] is None]
    shown, lines = study.keep[:4], []
    for values in itertools.product(*(sorted(study.grid[name]) for name in by)):
        group = [r for r in good if all(r[n] == v for n, v in zip(by, values, strict=True))]
        if group:
            names = [_value(name, v, study) for name, v in zip(by, values, strict=True)]
            means = [_mean(_column(group, c) * quantity(c, study)[1]) for c in shown]
            lines.append([*names, str(len(group)), *means])
    titles = [quantity(name, study)[0] for name in (*by, *shown)]
    return Table([*titles[: len(by)], "rows", *titles[len(by) :]], lines, len(by))


def _mean(values: Array) -> str:
    known = values[np.isfinite(values)]
    if not known.size:
        return "–"
    deviation = f" ± {known.std(ddof=1):.3f}" if known.size > 1 else ""
    return f"{known.mean():.3f}{deviation}"


def _page(study: Study, kept: Mapping[str, Kept], pictures: Sequence[str]) -> str:
    failed = [row for row in kept.values() if row["error"] is not None]
    errors = [
        [", ".join(f"{name} {row[name]}" for name in study.factors), row["error"]]
        for row in failed[:_MOST_ERRORS]
    ]
    draw = study.draw
    drawn = f"{draw.method}, {draw.count}, seed {draw.seed}" if study.spreads else "none"
    sources = sorted({row["sources"] for row in kept.values()})
    return document(
        f"Study {study.name}",
        [
            f"<p>{html.escape(study.about)}</p>" if study.about else "",
            f"<p>{len(kept)} of {len(study.rows)} rows are done, {len(failed)} of them failed. "
            f"Each row: {html.escape(study.task.text)}.</p>",
            *pictures,
            "<h2>Means</h2><p class='small'>Mean ± sample standard deviation over the seeds and "
            "every other factor that is not in the table.</p>",
            means_table(study, kept).html(),
            section(f"Failed rows, of {len(failed)}", Table(["row", "error"], errors)),
            section("Columns", _columns_table(study)),
            f"<p class='small'>Task {study.task.name}. Draws: {drawn}. Digest of sources and "
            f"libraries: {', '.join(sources)}. Python {platform.python_version()}, "
            f"{html.escape(platform.node())}, {platform.machine()}.</p>",
        ],
    )


def _columns_table(study: Study) -> Table:
    lines = []
    for name, each in study.factors.items():
        if name in study.grid:
            values = study.grid[name]
            text = ", ".join(map(str, values[:12])) + (" …" if len(values) > 12 else "")
        else:
            spread = study.spreads[name]
            text = f"{spread.scale}, {spread.low:g} … {spread.high:g}"
        lines.append([name, each.unit, text, each.text])
    lines += [[name, "", "kept", study.task.columns[name]] for name in study.keep]
    return Table(["column", "unit", "values", "what"], lines, 4)
