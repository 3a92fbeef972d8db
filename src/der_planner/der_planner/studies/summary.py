"""The end of a study: the table of all rows, the figures, and a page with both."""

from __future__ import annotations

import html
import itertools
import math
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from der_planner.results.report import document, figure, section
from der_planner.results.tables import Table
from der_planner.studies import cache
from der_planner.studies.factors import StudyError
from der_planner.studies.figures import draw, quantity, sobol_indices
from der_planner.studies.store import Kept, Store
from der_planner.studies.study import Study

_MOST_GROUPS = 60
_MOST_ERRORS = 50
_CAPTIONS = {
    "lines": "{y} over {x}: mean over all other factors, shaded one standard deviation.",
    "map": "{value} over {x} and {y}: mean over all other factors.",
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
    folder = store.folder / "report"
    try:
        folder.mkdir(exist_ok=True)
        drawn = draw(study, kept, folder)
        page = folder / "report.html"
        page.write_text(_page(study, kept, drawn), encoding="utf-8")
    except OSError as error:
        raise StudyError(f"cannot write into {folder}: {error.strerror}") from error
    return page


def text_table(study: Study, kept: Mapping[str, Kept]) -> str:
    """Return the groups of rows as a table for the terminal."""
    header, lines = _groups(study, kept)
    return Table(header, lines).text()


def _groups(study: Study, kept: Mapping[str, Kept]) -> tuple[list[str], list[list[str]]]:
    """Return mean ± standard deviation of each kept column for each combination of the grid.

    The seed is not a group but what the mean goes over, as is every factor with more values than
    the table could show.
    """
    by = [name for name, values in study.grid.items() if name != "seed" and len(values) > 1]
    good = [row for row in kept.values() if row["error"] is None]
    seen = {name: sorted({row[name] for row in good}) for name in by}
    while by and math.prod(len(seen[name]) for name in by) > _MOST_GROUPS:
        by.remove(max(by, key=lambda name: len(seen[name])))
    shown = list(study.keep)[:4]
    lines = []
    for values in itertools.product(*(seen[name] for name in by)):
        group = [r for r in good if all(r[n] == v for n, v in zip(by, values, strict=True))]
        if group:
            names = [_value(name, v, study) for name, v in zip(by, values, strict=True)]
            cells = [_mean([row[c] for row in group], quantity(c, study)[1]) for c in shown]
            lines.append([*names, str(len(group)), *cells])
    titles = [quantity(name, study)[0] for name in (*by, *shown)]
    return [*titles[: len(by)], "rows", *titles[len(by) :]], lines


def _value(name: str, value: Any, study: Study) -> str:
    return value if isinstance(value, str) else f"{value * quantity(name, study)[1]:.4g}"


def _mean(values: Sequence[float | None], factor: float) -> str:
    known = np.array([value for value in values if value is not None], dtype=float) * factor
    if not known.size:
        return "–"
    deviation = f" ± {known.std(ddof=1):.3f}" if known.size > 1 else ""
    return f"{known.mean():.3f}{deviation}"


def _page(study: Study, kept: Mapping[str, Kept], drawn: Mapping[str, Sequence[Path]]) -> str:
    failed = [row for row in kept.values() if row["error"] is not None]
    header, lines = _groups(study, kept)
    names = len(header) - 1 - len(list(study.keep)[:4])
    plots = {plot["name"]: plot for plot in study.plots}
    pictures = [
        figure(_caption(plots[name], study), path)
        for name, paths in drawn.items()
        for path in paths
        if path.suffix == ".png"
    ]
    return document(
        f"Study {study.name}",
        [
            f"<p>{html.escape(study.about)}</p>" if study.about else "",
            f"<p>{len(kept)} of {len(study.rows)} rows are done, {len(failed)} of them failed. "
            f"Each row: {html.escape(study.task.text)}.</p>",
            *pictures,
            "<h2>Means</h2><p class='small'>Mean ± sample standard deviation over the seeds and "
            "every other factor that is not in the table.</p>",
            Table(header, lines, names).html(),
            _index_table(study, kept),
            _failures(failed, study),
            section("Factors", _factor_table(study)),
            section(
                "Columns",
                Table(["column", "what"], [[c, study.task.columns[c]] for c in study.keep], 2),
            ),
            section("Where the numbers come from", _provenance(study, kept)),
        ],
    )


def _caption(plot: Mapping[str, str], study: Study) -> str:
    labels = {
        key: quantity(plot[key], study)[0] for key in ("x", "y", "value", "of") if key in plot
    }
    return plot.get("title") or _CAPTIONS[plot["kind"]].format(**labels)


def _index_table(study: Study, kept: Mapping[str, Kept]) -> str:
    parts = []
    for plot in study.plots:
        indices = sobol_indices(study, kept, plot["of"]) if plot["kind"] == "indices" else ()
        lines = [
            [
                each.factor,
                f"{each.first:.3f}",
                f"{each.first_range[0]:.3f} to {each.first_range[1]:.3f}",
                f"{each.total:.3f}",
                f"{each.total_range[0]:.3f} to {each.total_range[1]:.3f}",
            ]
            for each in sorted(indices, key=lambda each: -each.total)
        ]
        header = ["factor", "alone", "95 %", "total", "95 %"]
        if lines:
            parts.append(section(f"Sobol indices of {plot['of']}", Table(header, lines)))
    return "".join(parts)


def _failures(failed: Sequence[Kept], study: Study) -> str:
    if not failed:
        return ""
    lines = [
        [
            ", ".join(f"{name} {row[name]}" for name in study.factors),
            row["error"],
        ]
        for row in failed[:_MOST_ERRORS]
    ]
    more = f"<p>… and {len(failed) - len(lines)} more.</p>" if len(failed) > len(lines) else ""
    return section("Failed rows", Table(["row", "error"], lines)) + more


def _factor_table(study: Study) -> Table:
    lines = []
    for name, each in study.factors.items():
        if name in study.grid:
            values = study.grid[name]
            text = ", ".join(map(str, values[:12])) + (" …" if len(values) > 12 else "")
        else:
            spread = study.spreads[name]
            text = f"{spread.scale}, {spread.low:g} … {spread.high:g}"
        lines.append([name, each.unit, text, each.text])
    return Table(["factor", "unit", "values", "what"], lines, 4)


def _provenance(study: Study, kept: Mapping[str, Kept]) -> Table:
    sources = sorted({str(row["sources"]) for row in kept.values()})
    drawn = f"{study.draw.method}, {study.draw.count}, seed {study.draw.seed}"
    lines = [
        ["task", study.task.name],
        ["drawn", drawn if study.spreads else "nothing"],
        ["digest of sources and libraries", ", ".join(sources) or cache.digest()],
        ["python", platform.python_version()],
        ["machine of this page", f"{platform.node()}, {platform.machine()}"],
    ]
    return Table(["what", "value"], lines, 2)
