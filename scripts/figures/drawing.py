"""Where the pictures of the pages go, and how one is written."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt

from workspace_setup.basics import ROOT

matplotlib.use("Agg")

FOLDER = ROOT / "docs" / "pictures"


def save(figure: plt.Figure, path: Path, dpi: float) -> None:
    """Write a picture and say where it is."""
    figure.savefig(path, dpi=dpi)
    plt.close(figure)
    print(f"{path} ({path.stat().st_size // 1000} kB)", flush=True)
