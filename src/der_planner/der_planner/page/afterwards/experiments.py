"""Earlier experiments in a folder: their tables, figures and reports."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SHOWN = (".png", ".html", ".json", ".css", ".js", ".svg", ".csv", ".md", ".pdf", ".tex")
"""What a browser may fetch of an experiment."""
MOST = 200
"""Experiments in the list, the newest ones."""
COLUMNS = (
    "motion", "model", "method", "trial", "mean error [cm]", "largest [cm]", "seen [%]",
)  # fmt: skip


@dataclass(frozen=True)
class Experiment:
    """One folder that `run_experiment.py` wrote.

    Attributes:
        name: of the folder.
        rows: a run each, in the order of `COLUMNS`.
        figures: addresses within the folder.
        bags: of each row, in their order; empty where none is left.
        report: address within the folder; empty if there is none.
        problem: why the results cannot be read; else empty.
    """

    name: str
    rows: tuple[tuple[str, ...], ...]
    bags: tuple[str, ...]
    figures: tuple[str, ...]
    report: str
    problem: str = ""


class Experiments:
    """The folder in which experiments are.

    Args:
        folder: holds one folder an experiment, each with a results.json.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def names(self) -> list[str]:
        """Return the names of the experiments, the newest first."""
        try:
            found = [path.parent for path in self.folder.glob("*/results.json")]
            found.sort(key=lambda path: (path / "results.json").stat().st_mtime, reverse=True)
        except OSError:
            return []
        return [path.name for path in found[:MOST]]

    def load(self, name: str) -> Experiment:
        """Return what is to be shown of one experiment."""
        if name not in self.names():
            return Experiment(name, (), (), (), "", f"there is no experiment '{name}' any more")
        folder = self.folder / name
        try:
            runs = json.loads((folder / "results.json").read_text())["runs"]
            rows = tuple(_row(run) for run in runs)
            bags = tuple(_bag(folder, run) for run in runs)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            return Experiment(name, (), (), (), "", f"results.json cannot be read: {error}")
        figures = tuple(sorted(path.name for path in folder.glob("*.png")))
        report = "report/report.html"
        found = report if (folder / report).is_file() else ""
        return Experiment(name, rows, bags, figures, found)

    def recordings(self) -> dict[str, str]:
        """Return the bags of all experiments, the newest first: a name for people by its path."""
        found: dict[str, str] = {}
        for name in self.names():
            experiment = self.load(name)
            for row, bag in zip(experiment.rows, experiment.bags, strict=True):
                if bag:
                    found[bag] = f"{name}: {' '.join(row[:3])}, trial {row[3]}"
        return found

    def file(self, name: str, inside: str) -> Path | None:
        """Return a file of an experiment that may be shown; None for any other."""
        if name not in self.names():
            return None
        folder = (self.folder / name).resolve()
        try:
            path = (folder / inside).resolve()
        except (OSError, ValueError):
            return None
        inner = path.is_relative_to(folder) and path.suffix.lower() in SHOWN
        return path if inner and path.is_file() else None


def _bag(folder: Path, run: dict[str, Any]) -> str:
    """Return the path of a run's bag, also of an experiment that was moved with its bags."""
    named = str(run.get("bag") or "")
    if not named:
        return ""
    beside = folder / "bags" / Path(named).name
    return next((str(path.resolve()) for path in (beside, Path(named)) if path.exists()), "")


def _row(run: dict[str, Any]) -> tuple[str, ...]:
    return (
        str(run["motion"]), str(run["model"]), str(run["method"]), str(run["trial"]),
        _number(run.get("mean_error_m"), 100.0, 3), _number(run.get("max_error_m"), 100.0, 2),
        _number(run.get("valid_fraction"), 100.0, 0),
    )  # fmt: skip


def _number(value: Any, factor: float, digits: int) -> str:
    known = isinstance(value, int | float) and math.isfinite(value)
    return f"{value * factor:.{digits}f}" if known else "?"
