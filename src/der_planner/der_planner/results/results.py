"""``results.json`` and everything that stands beside it."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from der_planner.results.manners import side_by_side
from der_planner.results.metrics import RunResult
from der_planner.results.statistics import compare, summarise

FORMAT = 1


def results_document(results: Sequence[RunResult]) -> dict[str, Any]:
    """Return the content of ``results.json``: runs, summary over trials, comparisons, manners."""
    return {
        "format": FORMAT,
        "runs": [result.to_dict() for result in results],
        "summary": [row.to_dict() for row in summarise(results)],
        "comparisons": [entry.to_dict() for entry in compare(results)],
        "side_by_side": side_by_side(results),
    }


def write_results(results: Sequence[RunResult], folder: Path) -> Path:
    """Write ``results.json`` into a folder, whole or not at all, and return its path."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "results.json"
    unfinished = folder / ".results.json.part"
    text = json.dumps(results_document(results), indent=1, allow_nan=False)
    unfinished.write_text(text + "\n", encoding="utf-8")
    os.replace(unfinished, path)
    return path


def read_results(path: Path) -> list[RunResult]:
    """Return the runs of a ``results.json``."""
    document = json.loads(Path(path).read_text(encoding="utf-8"))
    return [RunResult.from_dict(entry) for entry in document["runs"]]
