"""What is written of results: results.json, and a page with the table and figures for a paper."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from string import Template
from typing import Any

from der_planner.bags.run import RunSeries
from der_planner.files import write_whole
from der_planner.results.evaluation import DRAWN, RunResult, json_value
from der_planner.results.figures import (
    plot_error,
    plot_learning,
    plot_pressures,
    plot_tip,
)
from der_planner.results.overlay import plot_shapes
from der_planner.results.statistics import CONTROLS, compare, side_by_side, summarise
from der_planner.results.tables import (
    CASE,
    CM,
    Table,
    csv_table,
    error_table,
    format_comparison,
    nearest_note,
    number,
    numbers,
    several_limbs,
    share,
)

FORMAT = 1
_CAPTIONS = {
    "error": "Tip error over time: mean over trials, shaded one standard deviation.",
    "tip": "Measured tip against the reference: path in the plane, x and y over time.",
    "shapes": "Planned and measured limb, over the camera's frames where these were recorded.",
    "pressures": "Differential pressures, commanded and measured; first trial of each model.",
    "learning": "Mean tip error over the runs that a plan was learned from, a line a trial.",
}
_PAGE = Template((Path(__file__).parent / "page.html").read_text(encoding="utf-8"))


def write_results(results: Sequence[RunResult], folder: Path) -> Path:
    """Write ``results.json`` into a folder, whole or not at all, and return its path.

    It holds the runs, a summary over trials, and comparisons.
    """
    content = {
        "format": FORMAT,
        "runs": [asdict(result) for result in results],
        "summary": [asdict(row) for row in summarise(results)],
        "comparisons": [asdict(entry) for entry in compare(results)],
        "side_by_side": side_by_side(results),
    }
    path = Path(folder) / "results.json"
    write_whole(path, json.dumps(json_value(content), indent=1, allow_nan=False) + "\n")
    return path


def write_report(
    runs: Sequence[RunSeries],
    results: Sequence[RunResult],
    folder: Path,
    *,
    progress: Callable[[str], None] = lambda _: None,
) -> Path:
    """Write page, tables and figures into a folder.

    Args:
        runs: for the figures, in the order of the results.
        results: of the same runs.
        folder: made if missing; receives ``report.html``, ``results.json``, ``table.md``,
            ``table.csv``, ``table.tex`` and each figure as PDF and PNG.
        progress: called with what is being made.

    Returns:
        The page.

    Raises:
        BagError: a bag cannot be read again for its frames.
    """
    folder = Path(folder)
    write_results(results, folder)
    rows = summarise(results)
    for name, text in (
        ("table.md", error_table(rows).markdown()),
        ("table.csv", csv_table(rows)),
        ("table.tex", error_table(rows).latex()),
    ):
        (folder / name).write_text(text, encoding="utf-8")
    figures: list[str] = []
    plots: dict[str, Callable[[], list[Path]]] = {
        "error": lambda: plot_error(runs, folder),
        "tip": lambda: plot_tip(runs, folder),
        "shapes": lambda: plot_shapes(runs, folder),
        "pressures": lambda: plot_pressures(runs, folder),
        "learning": lambda: plot_learning(results, folder),
    }
    for name, plot in plots.items():
        progress(f"figure {name}")
        figures += [figure(_CAPTIONS[name], path) for path in plot() if path.suffix == ".png"]
    page = folder / "report.html"
    page.write_text(document("Tracking errors", _sections(results, figures)), encoding="utf-8")
    return page


def document(title: str, sections: Sequence[str]) -> str:
    """Return a page, one file that opens from disk, of sections, which are HTML already."""
    return _PAGE.substitute(title=html.escape(title), body="\n".join(filter(None, sections)))


def figure(caption: str, path: Path) -> str:
    """Return a PNG within the page."""
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return (
        f'<figure><img alt="{html.escape(caption)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def section(title: str, table: Table) -> str:
    """Return a table with its title; nothing for a table without rows."""
    return f"<h2>{html.escape(title)}</h2>{table.html()}" if table.rows else ""


def _sections(results: Sequence[RunResult], figures: Sequence[str]) -> list[str]:
    return [
        error_table(summarise(results)).html(),
        *(f"<p>{html.escape(said)}</p>" for said in nearest_note(summarise(results))),
        *(f"<p>{html.escape(format_comparison(entry))}</p>" for entry in compare(results)),
        section("Open loop, feedback, learning", side_by_side_table(results)),
        *figures,
        section("Every run", _run_table(results)),
        section("What feedback added", _feedback_table(results)),
        section("Instruments", instrument_table(results)),
        (Path(__file__).parent / "definitions.html").read_text(encoding="utf-8"),
        section("Where the numbers come from", _provenance(results)),
    ]


def side_by_side_table(results: Sequence[RunResult]) -> Table:
    """Return the table of `side_by_side` in cm; without rows where nothing stands beside."""
    rows = side_by_side(results)

    def show(key: str) -> Callable[[dict[str, Any]], str]:
        return lambda row: number(row[key], CM, 3)

    columns: dict[str, Callable[[dict[str, Any]], str]] = {}
    if several_limbs(row["namespace"] for row in rows):
        columns["limb"] = lambda row: row["namespace"]
    if any(row["loads"] for row in rows):
        columns["loads"] = lambda row: row["loads"] or "horizontal"
    columns |= {
        "case": lambda row: CASE.get(row["motion"], row["motion"]),
        "model": lambda row: row["model"].upper(),
    }
    names = len(columns)
    for name in CONTROLS:
        head = name.replace("open_loop", "open loop").replace("_", " + ")
        columns[f"{head}, E [cm]"] = show(f"{name}_m")
    return Table.of(rows, columns, names)


Columns = dict[str, Callable[[RunResult], str]]


def _first_columns(results: Sequence[RunResult]) -> Columns:
    several = several_limbs(run.namespace for run in results)
    return {
        "run": lambda run: (
            f"{run.namespace if several else ''} {run.motion} {run.model} {run.method}".strip()
        ),
        "trial": lambda run: str(run.trial),
    }


def _run_table(results: Sequence[RunResult]) -> Table:
    columns: Columns = {
        "seed": lambda run: str(run.seed),
        "E [cm]": lambda run: number(run.mean_error_m, CM),
        "predicted E [cm]": lambda run: number(run.predicted_error_m, CM),
        "max [cm]": lambda run: number(run.max_error_m, CM),
        "valid": lambda run: share(run.valid_fraction),
        "images missing": lambda run: str(run.dropped_frames),
        "lag [s]": lambda run: number(run.lag_s, 1, 3),
        "gain x, y": lambda run: numbers((run.gain_x, run.gain_y)),
        "bias x, y [cm]": lambda run: numbers((run.bias_x_m, run.bias_y_m), CM),
        "RMS [cm]": lambda run: number(run.rms_error_m, CM),
        "without lag, bias, gain": lambda run: numbers(
            (run.rms_without_lag_m, run.rms_without_bias_m, run.rms_without_gain_m), CM
        ),
        "pressure RMS [kPa]": lambda run: numbers(run.pressure_rms_error_pa, 1e-3),
        "problems": lambda run: "; ".join(run.problems),
    }
    return Table.of(results, _first_columns(results) | columns)


def _feedback_table(results: Sequence[RunResult]) -> Table:
    """List what feedback added to the commands of each run that had it."""

    def told(run: RunResult, key: str) -> Any:
        return run.extra["feedback"].get(key)

    columns: Columns = {
        "added, RMS [kPa]": lambda run: numbers(told(run, "correction_rms_pa") or (), 1e-3),
        "largest [kPa]": lambda run: numbers(told(run, "correction_max_pa") or (), 1e-3),
        "estimate RMS [mm]": lambda run: number(told(run, "estimate_rms_m"), 1e3),
        "picture to board, median [ms]": lambda run: number(told(run, "latency_median_s"), 1e3, 0),
        "p99 [ms]": lambda run: number(told(run, "latency_p99_s"), 1e3, 0),
        "warnings": lambda run: "; ".join(told(run, "warnings") or ()) or "none",
    }
    corrected = [run for run in results if run.extra.get("feedback")]
    return Table.of(corrected, _first_columns(results) | columns)


def instrument_table(results: Sequence[RunResult]) -> Table:
    """Return how well tracker and board worked, a row for each run of the twin."""

    def show(key: str, scale: float = 1.0, digits: int = 0) -> Callable[[RunResult], str]:
        return lambda run: number(run.checks.get(key), scale, digits)

    columns: Columns = {
        "tracker RMS [mm]": show("tracker_rms_m", 1e3, 3),
        "setpoints": show("board_setpoints"),
        "lost": show("board_lost"),
        "out of order": show("board_out_of_order"),
        "late p50 [ms]": show("board_lateness_p50_s", 1e3, 2),
        "p99 [ms]": show("board_lateness_p99_s", 1e3, 2),
        "max [ms]": show("board_lateness_max_s", 1e3, 2),
    }
    return Table.of([run for run in results if run.checks], _first_columns(results) | columns)


def _provenance(results: Sequence[RunResult]) -> Table:
    """List what the runs say of themselves: one line where all agree, else every value."""
    rows = []
    for key in sorted({key for run in results for key in run.extra} - {"feedback", DRAWN}):
        values = dict.fromkeys(str(run.extra.get(key, "–")) for run in results)
        rows.append([key, ", ".join(values)])
    rows += [[f"bag of {run.model} {run.trial}", run.bag] for run in results if run.bag]
    return Table(["what", "value"], rows, names=2)
