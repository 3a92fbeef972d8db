"""A page of the results that opens from disk, and the table and figures for a paper beside it."""

from __future__ import annotations

import html
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from der_planner.bags.run import RunSeries
from der_planner.results.figures import plot_error, plot_pressures, plot_tip
from der_planner.results.html import document, figure, table
from der_planner.results.learning import plot_learning
from der_planner.results.manners import manners_table, plot_latency
from der_planner.results.metrics import RunResult
from der_planner.results.overlay import plot_shapes
from der_planner.results.results import write_results
from der_planner.results.statistics import Comparison, Summary, compare, summarise
from der_planner.results.table import (
    CASE,
    csv_table,
    format_comparison,
    format_value,
    latex_table,
    markdown_table,
    shows_loads,
    shows_namespace,
)

_CAPTIONS = {
    "latency": "From the instant of a picture to the first command at the board that knows of it.",
    "learning": "Mean tip error over the runs that a plan was learned from, a line a trial.",
    "error": "Tip error over time: mean over trials, shaded one standard deviation.",
    "tip": "Measured tip against the reference: path in the plane, x and y over time.",
    "shapes": "Planned and measured limb, over the camera's frames where these were recorded.",
    "pressures": "Differential pressures, commanded and measured; first trial of each model.",
}

_DEFINITIONS = """
<p>r̄ is the tip reference of the plan, interpolated linearly at the stamp of each image; r is the
tip that the tracker measured in that image. E is the mean of |r − r̄| over the valid images of the
window, E<sub>x</sub> and E<sub>y</sub> are the means of |x − x̄| and |y − ȳ|. The table shows mean ±
sample standard deviation of these over trials, and the largest |r − r̄| of any trial. Times come
from stamps; nothing is shifted. The split fits r(t) ≈ g r̄(t − τ) + b: lag τ, gains g, bias b, and
the RMS error that is left when lag, then bias, then gain are taken out. Models are compared under
the same loads; where a comparison says that methods differ, too, it is not one of models alone.</p>
"""


@dataclass(frozen=True)
class Report:
    """What was written: the page, and everything beside it."""

    page: Path
    files: tuple[Path, ...]


def write_report(
    runs: Sequence[RunSeries],
    results: Sequence[RunResult],
    folder: Path,
    *,
    title: str = "Tracking errors",
    drawn: Sequence[Path] = (),
    progress: Callable[[str], None] | None = None,
) -> Report:
    """Write page, tables and figures into a folder.

    Args:
        runs: for the figures, in the order of the results.
        results: of the same runs.
        folder: made if missing; receives ``report.html``, ``results.json``, ``table.md``,
            ``table.csv``, ``table.tex`` and each figure as PDF and PNG.
        title: of the page.
        drawn: files of figures of the same runs that exist already; they are copied.
        progress: called with what is being made.

    Returns:
        The written files.

    Raises:
        BagError: a bag cannot be read again for its frames.
    """
    say = progress or (lambda _: None)
    folder = Path(folder)
    files = [write_results(results, folder)]
    rows, comparisons = summarise(results), compare(results)
    for name, text in (
        ("table.md", markdown_table(rows)),
        ("table.csv", csv_table(rows)),
        ("table.tex", latex_table(rows)),
    ):
        files.append(folder / name)
        files[-1].write_text(text, encoding="utf-8")
    figures: dict[str, Path] = {}
    for name, plot in (
        ("error", plot_error),
        ("tip", plot_tip),
        ("shapes", plot_shapes),
        ("pressures", plot_pressures),
        ("learning", lambda _, place: plot_learning(results, place)),
        ("latency", lambda _, place: plot_latency(results, place)),
    ):
        ready = [path for path in drawn if path.stem == name]
        if ready:
            written = [Path(shutil.copy(path, folder)) for path in ready]
        else:
            say(f"figure {name}")
            written = plot(runs, folder)
        files += written
        pictures = [path for path in written if path.suffix == ".png"]
        if pictures:
            figures[name] = pictures[0]
    page = folder / "report.html"
    page.write_text(_page(title, results, rows, comparisons, figures), encoding="utf-8")
    return Report(page, (*files, page))


def _page(
    title: str,
    results: Sequence[RunResult],
    rows: Sequence[Summary],
    comparisons: Sequence[Comparison],
    figures: dict[str, Path],
) -> str:
    sections = [
        f"<h1>{html.escape(title)}</h1>",
        _summary_table(rows),
        "".join(f"<p>{html.escape(format_comparison(entry))}</p>" for entry in comparisons),
        manners_table(results),
        *(figure(_CAPTIONS[name], path) for name, path in figures.items()),
        "<h2>Every run</h2>",
        _run_table(results),
        _feedback_table(results),
        _checks_table(results),
        "<h2>Definitions</h2>",
        _DEFINITIONS,
        "<h2>Where the numbers come from</h2>",
        _provenance(results),
    ]
    return document(title, sections)


def _summary_table(rows: Sequence[Summary]) -> str:
    several, loaded = shows_namespace(rows), shows_loads(rows)
    lines = [
        [
            *([html.escape(row.namespace)] if several else []),
            *([html.escape(row.loads or "horizontal")] if loaded else []),
            html.escape(CASE.get(row.motion, row.motion)),
            html.escape(row.model.upper()),
            html.escape(row.method),
            str(row.trials),
            format_value(row.mean_error_m, row.std_error_m),
            format_value(row.mean_error_x_m, row.std_error_x_m),
            format_value(row.mean_error_y_m, row.std_error_y_m),
            f"{row.max_error_m * 100:.2f}",
            _number(row.predicted_error_m, 100),
        ]
        for row in rows
    ]
    header = [
        *(["limb"] if several else []),
        *(["loads"] if loaded else []),
        *("case", "model", "method", "trials", "E [cm]", "E<sub>x</sub> [cm]"),
        *("E<sub>y</sub> [cm]", "max [cm]", "predicted E [cm]"),
    ]
    return table(header, lines, names=3 + several + loaded)


def _number(value: float, scale: float = 1.0, digits: int = 2) -> str:
    return "–" if math.isnan(value) else f"{value * scale:.{digits}f}"


def _run_name(run: RunResult, several: bool, method: str = "") -> str:
    return f"{run.namespace if several else ''} {run.motion} {run.model} {method}".strip()


def _run_table(results: Sequence[RunResult]) -> str:
    lines = []
    several = shows_namespace(results)
    for run in results:
        problems = "; ".join(run.problems)
        lines.append(
            [
                html.escape(_run_name(run, several, run.method)),
                str(run.trial),
                str(run.seed),
                _number(run.mean_error_m, 100),
                _number(run.max_error_m, 100),
                f"{math.floor(run.valid_fraction * 1000) / 10:.1f} %",
                str(run.dropped_frames),
                _number(run.lag_s, 1, 3),
                f"{_number(run.gain_x)}, {_number(run.gain_y)}",
                f"{_number(run.bias_x_m, 100)}, {_number(run.bias_y_m, 100)}",
                " → ".join(
                    _number(value, 100)
                    for value in (
                        run.rms_error_m,
                        run.rms_without_lag_m,
                        run.rms_without_bias_m,
                        run.rms_without_gain_m,
                    )
                ),
                ", ".join(_number(value, 1e-3) for value in run.pressure_rms_error_pa) or "–",
                f'<span class="problem">{html.escape(problems)}</span>' if problems else "",
            ]
        )
    header = [
        *("run", "trial", "seed", "E [cm]", "max [cm]", "valid", "images missing", "lag [s]"),
        *("gain x, y", "bias x, y [cm]", "RMS [cm] without lag, bias, gain"),
        *("pressure RMS [kPa]", "problems"),
    ]
    return table(header, lines, names=1)


def _feedback_table(results: Sequence[RunResult]) -> str:
    """List what feedback added to the commands of each run that had it."""
    corrected = [run for run in results if run.extra.get("feedback")]
    if not corrected:
        return ""
    several, lines = shows_namespace(results), []
    for run in corrected:
        about = run.extra["feedback"]
        lines.append(
            [
                html.escape(_run_name(run, several, run.method)),
                str(run.trial),
                *(
                    ", ".join(_number(value, 1e-3) for value in about.get(key, ()))
                    for key in ("correction_rms_pa", "correction_max_pa")
                ),
                _number(about.get("estimate_rms_m", math.nan), 1000),
                *(
                    _number(about.get(key, math.nan), 1000, 0)
                    for key in ("latency_median_s", "latency_p99_s")
                ),
                html.escape("; ".join(about.get("warnings", ())) or "none"),
            ]
        )
    header = [
        *("run", "trial", "added, RMS [kPa]", "largest [kPa]", "estimate RMS [mm]"),
        *("picture to board, median [ms]", "p99 [ms]", "warnings"),
    ]
    return "<h2>What feedback added</h2>" + table(header, lines, names=1)


def _checks_table(results: Sequence[RunResult]) -> str:
    checked = [run for run in results if run.checks]
    if not checked:
        return ""
    several = shows_namespace(results)
    lines = [
        [
            html.escape(_run_name(run, several)),
            str(run.trial),
            _number(run.checks.get("tracker_rms_m", math.nan), 1000, 3),
            _count(run, "board_setpoints"),
            _count(run, "board_lost"),
            _count(run, "board_out_of_order"),
            _number(run.checks.get("board_lateness_p50_s", math.nan), 1000),
            _number(run.checks.get("board_lateness_p99_s", math.nan), 1000),
            _number(run.checks.get("board_lateness_max_s", math.nan), 1000),
        ]
        for run in checked
    ]
    header = [
        *("run", "trial", "tracker RMS [mm]", "setpoints", "lost", "out of order"),
        *("late p50 [ms]", "p99 [ms]", "max [ms]"),
    ]
    return "<h2>Instruments</h2>" + table(header, lines, names=1)


def _count(run: RunResult, name: str) -> str:
    value = run.checks.get(name)
    return "–" if value is None else f"{value:.0f}"


def _provenance(results: Sequence[RunResult]) -> str:
    """List what the runs say of themselves: one line where all agree, else every value."""
    keys = sorted({key for run in results for key in run.extra} - {"feedback"})
    lines = []
    for key in keys:
        values = list(dict.fromkeys(str(run.extra.get(key, "–")) for run in results))
        lines.append([html.escape(key), html.escape(", ".join(values))])
    for run in results:
        if run.bag:
            lines.append(
                [f"bag of {html.escape(f'{run.model} {run.trial}')}", html.escape(run.bag)]
            )
    return table(["", ""], lines, names=2)
