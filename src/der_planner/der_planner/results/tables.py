"""Tables as text, Markdown, LaTeX and HTML, all from the same cells; the table of errors; CSV."""

from __future__ import annotations

import csv
import html
import io
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import TypeVar

from der_planner.results.evaluation import NEAREST
from der_planner.results.statistics import CONFIDENCE, Comparison, Summary

CASE = {
    "asynchronous": "1, asynchronous",
    "same_direction": "2, same direction",
    "opposite_direction": "3, opposite direction",
}
CM = 100.0
LONG = 50
"""Cells of more characters are broken into lines on a page."""
Entry = TypeVar("Entry")


@dataclass(frozen=True)
class Table:
    """Cells as people read them.

    Attributes:
        header: of the columns.
        rows: of plain text.
        names: the first columns, as many as this, hold names and stand to the left on a page.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    names: int = 1

    @classmethod
    def of(
        cls,
        entries: Sequence[Entry],
        columns: Mapping[str, Callable[[Entry], str]],
        names: int = 1,
    ) -> Table:
        """Return a table with a row for each entry; a column is its header and what it shows."""
        rows = [[show(entry) for show in columns.values()] for entry in entries]
        return cls(list(columns), rows, names)

    def text(self) -> str:
        """Return the table for a terminal."""
        widths = [max(map(len, column)) for column in zip(self.header, *self.rows, strict=True)]
        lines = [self.header, ["-" * width for width in widths], *self.rows]
        return "\n".join(
            "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
            for line in lines
        )

    def markdown(self) -> str:
        """Return the table as Markdown."""
        lines = [self.header, ["---"] * len(self.header), *self.rows]
        return "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def latex(self) -> str:
        r"""Return the table for ``\usepackage{booktabs}``, with space before each new name."""
        lines = [
            rf"\begin{{tabular}}{{{'l' * self.names}{'r' * (len(self.header) - self.names)}}}",
            r"\toprule",
            " & ".join(re.sub(r"\bE(_[xy])?(?= )", r"$\g<0>$", text) for text in self.header),
        ]
        lines[-1] += r" \\" + "\n" + r"\midrule"
        last = ""
        for name, *cells in self.rows:
            if last and name != last:
                lines.append(r"\addlinespace")
            lines.append(" & ".join(map(_latex, ["" if name == last else name, *cells])) + r" \\")
            last = name
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])

    def html(self) -> str:
        """Return the table for a page."""
        head = "".join(self._cell("th", *each) for each in enumerate(self.header))
        body = "".join(
            f"<tr>{''.join(self._cell('td', *each) for each in enumerate(row))}</tr>"
            for row in self.rows
        )
        return (
            f'<div class="wide"><table><thead><tr>{head}</tr></thead>'
            f"<tbody>{body}</tbody></table></div>"
        )

    def _cell(self, tag: str, column: int, text: str) -> str:
        kind = "long" if len(text) > LONG else "name" if column < self.names else ""
        mark = f' class="{kind}"' if kind else ""
        return f"<{tag}{mark}>{html.escape(text)}</{tag}>"


def _latex(text: str) -> str:
    escaped = re.sub(r"([&%$#_{}])", r"\\\1", text)
    return re.sub(r"(\S+) ± (\S+)", r"$\1 \\pm \2$", escaped)


def number(value: float | None, scale: float = 1.0, digits: int = 2) -> str:
    """Return a number times a scale; a dash for what is not known."""
    return "–" if value is None or math.isnan(value) else f"{value * scale:.{digits}f}"


def numbers(values: Sequence[float], scale: float = 1.0) -> str:
    """Return numbers in a row; a dash for none."""
    return ", ".join(number(value, scale) for value in values) or "–"


def share(value: float) -> str:
    """Return a fraction in per cent, never rounded up."""
    return f"{math.floor(value * 1000) / 10:.1f} %"


def _spread(mean: float, deviation: float) -> str:
    """Return ``mean ± deviation`` of metres in cm; the mean alone where there is one trial."""
    return number(mean, CM) + ("" if math.isnan(deviation) else f" ± {number(deviation, CM)}")


def several_limbs(namespaces: Iterable[str]) -> bool:
    """Tell whether namespaces are of limbs that have to be told apart."""
    return len(set(namespaces) - {""}) > 1


def error_table(rows: Sequence[Summary]) -> Table:
    """Return the table of errors, a row per limb, loads, motion, model and method."""
    columns: dict[str, Callable[[Summary], str]] = {}
    if several_limbs(row.namespace for row in rows):
        columns["limb"] = lambda row: row.namespace
    if any(row.loads for row in rows):
        columns["loads"] = lambda row: row.loads or "horizontal"
    columns |= {
        "case": lambda row: CASE.get(row.motion, row.motion),
        "model": lambda row: row.model.upper(),
        "method": lambda row: row.method,
    }
    names = len(columns)
    columns |= {
        "trials": lambda row: str(row.trials),
        "E [cm]": lambda row: _spread(row.mean_error_m, row.std_error_m),
        "E_x [cm]": lambda row: _spread(row.mean_error_x_m, row.std_error_x_m),
        "E_y [cm]": lambda row: _spread(row.mean_error_y_m, row.std_error_y_m),
        "max [cm]": lambda row: number(row.max_error_m, CM),
        "valid": lambda row: share(row.valid_fraction),
    }
    return Table.of(rows, columns, names)


def format_table(rows: Sequence[Summary], comparisons: Sequence[Comparison] = ()) -> str:
    """Return the table for a terminal, then one line for each comparison."""
    lines = [error_table(rows).text()]
    lines += [format_comparison(comparison) for comparison in comparisons]
    lines += [f"note: {_named(row)} {row.model}: {text}" for row in rows for text in row.problems]
    return "\n".join([*lines, *nearest_note(rows)])


def nearest_note(rows: Sequence[Summary]) -> list[str]:
    """Return a sentence on what errors count from, where a path was drawn that is out of reach."""
    said = "nearest path: the reference is the nearest path in reach, not the drawn one (grey dots)"
    return [said] if any(row.motion.endswith(NEAREST) for row in rows) else []


def format_comparison(comparison: Comparison) -> str:
    """Return one sentence that a reader can quote."""
    who = f"{_named(comparison)}: {comparison.model} against {comparison.baseline}"
    if comparison.model.partition(" ")[2] != comparison.baseline.partition(" ")[2]:
        who += " (methods differ, not only models)"
    if comparison.refused:
        return f"{who}: not compared, {comparison.refused}"
    text = f"{who}: {abs(comparison.difference_m) * CM:.2f} cm "
    text += "less" if comparison.difference_m >= 0 else "more"
    if math.isnan(comparison.low_m):
        return f"{text} error (one trial, no interval)"
    how = "paired by seed" if comparison.paired else "unpaired"
    return (
        f"{text} error, {CONFIDENCE:.0%} interval of the difference "
        f"{comparison.low_m * CM:.2f} to {comparison.high_m * CM:.2f} cm ({how}, bootstrap)"
    )


def _named(entry: Summary | Comparison) -> str:
    loads = f" ({entry.loads})" if entry.loads else ""
    return f"{entry.namespace} {entry.motion}{loads}".strip()


def csv_table(rows: Sequence[Summary]) -> str:
    """Return the table as CSV, in SI units with the unit in each column's name."""
    names = [field.name for field in fields(Summary) if field.name != "problems"]
    text = io.StringIO()
    writer = csv.DictWriter(text, names, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    return text.getvalue()
