"""Play a study: a table of many runs, on all cores of this machine or on a Dask cluster.

    python3 scripts/study.py accuracy                          a shipped study, or any STUDY.yaml
    python3 scripts/study.py accuracy --limit 24               its first rows, to see what comes
    python3 scripts/study.py my.yaml --scheduler tcp://host:8786
    python3 scripts/study.py --list                            shipped studies, factors and columns

Rows go to OUT/rows.jsonl as they finish; a study that was stopped, killed or cut off goes on
where it was with the same --out. At the end: OUT/rows.csv, figures, OUT/report/report.html.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from der_planner.experiment.console import OptionError, Progress, command, interrupt_once
from der_planner.studies.conduct import PlaySettings, Store, conduct
from der_planner.studies.factors import ERROR, PLANNED, StudyError, limb_parameters, of_task
from der_planner.studies.report import means_table, summarise
from der_planner.studies.study import SHIPPED, Study
from der_planner.studies.tasks import TASKS


def _options(parser: argparse.ArgumentParser) -> argparse.Namespace:
    parser.add_argument("study", nargs="?", metavar="STUDY.yaml", help="file, or a shipped name")
    parser.add_argument(
        "--scheduler",
        default="",
        metavar="ADDRESS",
        help="of a running Dask cluster, as tcp://host:8786; without it: processes of this machine",
    )
    parser.add_argument(
        "--workers", type=int, metavar="N", help="processes of this machine (default: one a core)"
    )
    parser.add_argument(
        "--limit", type=int, metavar="ROWS", help="only the first rows of the table"
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="where rows, figures and the report go, and what is gone on with "
        "(default: studies/ and the study's name)",
    )
    parser.add_argument(
        "--retry-failed", action="store_true", help="do rows again that ended with an error"
    )
    parser.add_argument(
        "--list", action="store_true", help="shipped studies, tasks, factors and columns"
    )
    return parser.parse_args()


@command(
    StudyError,
    stopped="what was done is kept, and the same command with the same --out goes on from here",
)
def main(parser: argparse.ArgumentParser) -> int:
    """Run the command line.

    Returns:
        0 when every row is done, also failed ones; 1 if the study could not be played; 2 for a bad
        option; 130 if it was stopped.
    """
    given = _options(parser)
    if given.list:
        print(_listing())
        return 0
    if given.study is None:
        raise OptionError("name a study: a file, or one of those that --list shows")
    for name in ("workers", "limit"):
        if getattr(given, name) is not None and getattr(given, name) < 1:
            raise OptionError(f"--{name} is {getattr(given, name)}: 1 or more")
    if given.scheduler and given.workers:
        raise OptionError("--workers is for this machine: a cluster of --scheduler has its own")
    interrupt_once()
    study = Study.read(given.study)
    out = (given.out or Path("studies") / study.name).resolve()
    progress = Progress()
    settings = PlaySettings(out, given.scheduler, given.workers, given.limit, given.retry_failed)
    kept = conduct(study, settings, progress)
    page = summarise(study, kept, Store(out, study))
    failed = sum(row["error"] is not None for row in kept.values())
    print(means_table(study, kept).text())
    progress.say(f"{len(kept)} of {len(study.rows)} rows are done, {failed} of them failed")
    if failed:
        progress.say("failed rows are in the report; --retry-failed does them again")
    progress.say(f"rows: {out}/rows.csv, {out}/rows.jsonl")
    progress.say(f"report: {page}")
    return 0


def _listing() -> str:
    lines = ["shipped studies (file: what they ask)"]
    for path in sorted(SHIPPED.glob("*.yaml")):
        study = Study.read(path)
        lines.append(f"  {path.stem}: {len(study.rows)} rows. {' '.join(study.about.split())}")
    for task in TASKS.values():
        lines += ["", f"task {task.name}: {task.text}", "  factors"]
        for name, each in of_task(task.name).items():
            unit = "" if each.unit == "-" else f" [{each.unit}]"
            lines.append(f"    {name}{unit}: {each.text}; {each.range}; default {each.default}")
        if task.name in PLANNED:
            lines.append(f"    {ERROR}PARAMETER or {ERROR}PARAMETER[segment]: relative error of")
            lines.append(f"      {', '.join(limb_parameters())}")
        lines.append("  columns")
        lines += [f"    {name}: {text}" for name, text in task.columns.items()]
    return "\n".join(lines)
