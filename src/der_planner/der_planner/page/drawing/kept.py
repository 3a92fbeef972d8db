"""Drawings kept in a folder: CSV files that `run_experiment.py --path` reads, too."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from der_planner.planning import PlanningError
from der_planner.planning.paths import read_csv

Array = NDArray[np.float64]

LONGEST_NAME = 60
MOST_POINTS = 20_000
_WRONG = re.compile(r"[^\w-]+")
"""Letters and digits of any language are a name's own; a folder's marks and dots are not."""


class DrawingError(ValueError):
    """A drawing cannot be kept or read; the message says why."""


def file_name(name: str) -> str:
    """Return a name that can only be a file in the folder itself.

    Raises:
        DrawingError: nothing is left of it.
    """
    kept = _WRONG.sub("_", name.strip()).strip("_-")[:LONGEST_NAME]
    if not kept:
        raise DrawingError("a drawing needs a name with letters or digits")
    return kept


class Drawings:
    """A folder of drawings.

    Args:
        folder: made when the first one is kept.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def names(self) -> list[str]:
        """Return the names of all drawings."""
        return sorted(path.stem for path in self.folder.glob("*.csv") if path.is_file())

    def save(self, name: str, tip: Array) -> str:
        """Keep points (P, 2) [m]; return the name under which.

        Raises:
            DrawingError: no usable name, there is one of that name, or the folder cannot be used.
        """
        kept = file_name(name)
        lines = [f"{x * 100:.4f}, {y * 100:.4f}" for x, y in tip]
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with (self.folder / f"{kept}.csv").open("x") as stream:
                stream.write("\n".join(["x [cm], y [cm]", *lines]) + "\n")
        except FileExistsError as error:
            raise DrawingError(
                f"there is a drawing '{kept}' already: choose another name"
            ) from error
        except OSError as error:
            raise DrawingError(f"cannot write into {self.folder}: {error.strerror}") from error
        return kept

    def load(self, name: str) -> Array:
        """Return the points (P, 2) [m] of a drawing.

        Raises:
            DrawingError: there is none of that name, or its file is no path.
        """
        if name not in self.names():  # so that no name leads out of the folder
            raise DrawingError(f"there is no drawing '{name}' in {self.folder}")
        path = self.folder / f"{name}.csv"
        try:
            _, tip = read_csv(path)
        except PlanningError as error:
            raise DrawingError(str(error)) from error
        if len(tip) > MOST_POINTS:
            raise DrawingError(f"{path} has {len(tip)} points: {MOST_POINTS} at most can be shown")
        return tip
