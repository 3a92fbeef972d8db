"""The table of errors as text, Markdown, CSV and LaTeX, all from the same rows."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence

from der_planner.results.metrics import RunResult
from der_planner.results.statistics import Comparison, Summary

CASE = {
    "asynchronous": "1, asynchronous",
    "same_direction": "2, same direction",
    "opposite_direction": "3, opposite direction",
}
_HEADER = (
    "case",
    "model",
    "method",
    "trials",
    "E [cm]",
    "E_x [cm]",
    "E_y [cm]",
    "max [cm]",
    "valid",
)


def format_value(mean: float, deviation: float) -> str:
    """Return ``mean ± deviation`` of metres in cm; the mean alone where there is one trial."""
    if math.isnan(deviation):
        return f"{mean * 100:.2f}"
    return f"{mean * 100:.2f} ± {deviation * 100:.2f}"


def shows_namespace(rows: Sequence[Summary] | Sequence[RunResult]) -> bool:
    """Tell whether a table needs a column that tells limbs apart."""
    return len({row.namespace for row in rows} - {""}) > 1


def shows_loads(rows: Sequence[Summary] | Sequence[RunResult]) -> bool:
    """Tell whether a table needs a column of mountings and payloads."""
    return any(row.loads for row in rows)


def _lines(rows: Sequence[Summary]) -> list[list[str]]:
    """Return the header and the rows of a table as text."""
    extra = {}
    if shows_namespace(rows):
        extra["limb"] = [row.namespace for row in rows]
    if shows_loads(rows):
        extra["loads"] = [row.loads or "horizontal" for row in rows]
    return [
        [*extra, *_HEADER],
        *([*(column[i] for column in extra.values()), *_cells(row)] for i, row in enumerate(rows)),
    ]


def _cells(row: Summary) -> list[str]:
    return [
        CASE.get(row.motion, row.motion),
        row.model.upper(),
        row.method,
        str(row.trials),
        format_value(row.mean_error_m, row.std_error_m),
        format_value(row.mean_error_x_m, row.std_error_x_m),
        format_value(row.mean_error_y_m, row.std_error_y_m),
        f"{row.max_error_m * 100:.2f}",
        f"{math.floor(row.valid_fraction * 1000) / 10:.1f} %",
    ]


def format_table(rows: Sequence[Summary], comparisons: Sequence[Comparison] = ()) -> str:
    """Return the table for a terminal, then one line for each comparison."""
    cells = _lines(rows)
    widths = [max(len(line[column]) for line in cells) for column in range(len(cells[0]))]
    lines = [
        "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip()
        for line in cells
    ]
    lines.insert(1, "  ".join("-" * width for width in widths))
    lines += [format_comparison(comparison) for comparison in comparisons]
    lines += [f"note: {_named(row)} {row.model}: {text}" for row in rows for text in row.problems]
    return "\n".join(lines)


def format_comparison(comparison: Comparison) -> str:
    """Return one sentence that a reader can quote."""
    who = f"{_named(comparison)}: {comparison.model} against {comparison.baseline}"
    if comparison.model.partition(" ")[2] != comparison.baseline.partition(" ")[2]:
        who += " (methods differ, not only models)"
    if comparison.refused:
        return f"{who}: not compared, {comparison.refused}"
    text = f"{who}: {abs(comparison.difference_m) * 100:.2f} cm "
    text += "less" if comparison.difference_m >= 0 else "more"
    if math.isnan(comparison.low_m):
        return f"{text} error (one trial, no interval)"
    how = "paired by seed" if comparison.paired else "unpaired"
    return (
        f"{text} error, {comparison.confidence:.0%} interval of the difference "
        f"{comparison.low_m * 100:.2f} to {comparison.high_m * 100:.2f} cm ({how}, bootstrap)"
    )


def _named(entry: Summary | Comparison) -> str:
    loads = f" ({entry.loads})" if entry.loads else ""
    return f"{entry.namespace} {entry.motion}{loads}".strip()


def markdown_table(rows: Sequence[Summary]) -> str:
    """Return the table as Markdown."""
    header, *cells = _lines(rows)
    lines = ["| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    lines += ["| " + " | ".join(line) + " |" for line in cells]
    return "\n".join(lines) + "\n"


def csv_table(rows: Sequence[Summary]) -> str:
    """Return the table as CSV, in SI units with the unit in each column's name."""
    names = [
        "motion", "model", "method", "trials", "mean_error_m", "mean_error_x_m", "mean_error_y_m",
        "std_error_m", "std_error_x_m", "std_error_y_m", "max_error_m", "valid_fraction",
        "predicted_error_m", "namespace", "loads",
    ]  # fmt: skip
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        values = [getattr(row, name) for name in names]
        writer.writerow(["" if isinstance(v, float) and math.isnan(v) else v for v in values])
    return text.getvalue()


def latex_table(rows: Sequence[Summary]) -> str:
    r"""Return the table as LaTeX for ``\usepackage{booktabs}``, a row per case and model."""
    lines = [
        r"\begin{tabular}{llrrrr}",
        r"\toprule",
        r"Case & Model & $E$ [cm] & $E_x$ [cm] & $E_y$ [cm] & max [cm] \\",
        r"\midrule",
    ]
    several = shows_namespace(rows)
    last = ""
    for row in rows:
        name = CASE.get(row.motion, row.motion)
        name = f"{name}, {row.namespace}" if several else name
        name = f"{name}, {row.loads}" if row.loads else name
        if last and name != last:
            lines.append(r"\addlinespace")
        case = name if name != last else ""
        last = name
        numbers = [
            _latex_value(row.mean_error_m, row.std_error_m),
            _latex_value(row.mean_error_x_m, row.std_error_x_m),
            _latex_value(row.mean_error_y_m, row.std_error_y_m),
            f"{row.max_error_m * 100:.2f}",
        ]
        model = f"{row.model.upper()} ({row.method})" if row.method else row.model.upper()
        lines.append(" & ".join([_escape(case), _escape(model), *numbers]) + r" \\")
    lines += [r"\bottomrule", r"\end{tabular}"]
    return "\n".join(lines) + "\n"


def _latex_value(mean: float, deviation: float) -> str:
    return "$" + format_value(mean, deviation).replace("±", r"\pm") + "$"


def _escape(text: str) -> str:
    for character in "&%$#_{}":
        text = text.replace(character, "\\" + character)
    return text
