"""Rows of a study that goes on where it was stopped, as CSV: a dataclass of numbers and text."""

from __future__ import annotations

import csv
import dataclasses
import subprocess
from pathlib import Path
from typing import TypeVar

from workspace_setup.basics import ROOT

Kind = TypeVar("Kind")
_READ = {"int": int, "float": float, "str": str}


def read(kind: type[Kind], path: Path) -> list[Kind]:
    """Return the rows of a file; none if it is not there yet."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [
            kind(**{f.name: _READ[str(f.type)](text[f.name]) for f in dataclasses.fields(kind)})
            for text in csv.DictReader(file)
        ]


def append(row: object, path: Path) -> None:
    """Write one row at the end of a file, with a heading if it is new."""
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        if new:
            writer.writerow([field.name for field in dataclasses.fields(row)])
        values = dataclasses.astuple(row)
        writer.writerow([f"{v:.7g}" if isinstance(v, float) else v for v in values])


def commit() -> str:
    """Return the program's commit, or nothing outside of a repository."""
    command = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
