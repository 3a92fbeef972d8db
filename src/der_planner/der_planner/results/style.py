"""Looks of every figure: a paper's column, colours that colour-blind readers tell apart."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

COLUMN = 3.5
"""Width of a column of a two-column paper [inch]."""
PAGE = 7.16
"""Width of both columns [inch]."""
# Okabe and Ito's palette (2008).
REFERENCE = "#000000"
COLOURS = {"der": "#0072B2", "pcc": "#D55E00"}
OTHER = ("#009E73", "#CC79A7", "#E69F00", "#56B4E9")
DASHES = {"der": "-", "pcc": "--"}


def colour(model: str, index: int = 0) -> str:
    """Return the colour of a model, or the index-th of the rest for an unknown one."""
    return COLOURS.get(model, OTHER[index % len(OTHER)])


@contextmanager
def paper_style() -> Iterator[None]:
    """Set font sizes and line widths of a two-column paper, without touching the caller's."""
    settings: dict[str, Any] = {
        "font.size": 8,
        "axes.titlesize": 8,
        "axes.labelsize": 8,
        "legend.fontsize": 7,
        "xtick.labelsize": 7,
        "ytick.labelsize": 7,
        "lines.linewidth": 1.2,
        "axes.linewidth": 0.6,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
        "pdf.fonttype": 42,
        "svg.fonttype": "none",
        "savefig.dpi": 160,
        "figure.constrained_layout.use": True,
    }
    with mpl.rc_context(settings):
        yield


def save(figure: Figure, folder: Path, name: str, formats: tuple[str, ...]) -> list[Path]:
    """Write a figure in every format and return the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for suffix in formats:
        path = folder / f"{name}.{suffix}"
        # Without a date in it, the same runs give the same file.
        stripped = {"CreationDate": None} if suffix == "pdf" else None
        figure.savefig(path, metadata=stripped)
        paths.append(path)
    return paths
