"""Sheets to print: tags of the limb, fixed tags and the calibration board, in true size.

A page is a list of black rectangles and labels in millimetres, written as PDF: its vectors keep
the edges of the tags as straight as the printer is.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as MatplotlibPath
from numpy.typing import NDArray

from apriltag_tracker.family import Family
from apriltag_tracker.tag_map import TagMap

PAPERS = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}
_MARGIN = 12.0
_INCH = 25.4  # mm
_POINTS = 72.0 / _INCH  # points of a font to a mm


class SheetError(ValueError):
    """Something does not fit on the paper; the message says what and what would."""


@dataclass
class Page:
    """One page; x to the right, y down, in mm."""

    width: float
    height: float
    rectangles: list[tuple[float, float, float, float]] = field(default_factory=list)
    cuts: list[tuple[float, float, float, float]] = field(default_factory=list)
    labels: list[tuple[float, float, float, str]] = field(default_factory=list)


BOARD_MARKERS = 100
"""In OpenCV's dictionary DICT_4X4_100."""


@dataclass(frozen=True)
class BoardLayout:
    """A ChArUco board: squares across and down, their edge and that of the markers [m]."""

    columns: int = 9
    rows: int = 6
    square: float = 0.025
    marker: float = 0.018

    def __post_init__(self) -> None:
        """Check the measures.

        Raises:
            SheetError: there are too few squares, or the markers do not fit into them.
        """
        if min(self.columns, self.rows) < 3:
            raise SheetError(
                f"a board of {self.columns} x {self.rows} squares: take 3 or more each way"
            )
        if not 0.0 < self.marker < self.square < math.inf:
            raise SheetError(
                f"markers of {1e3 * self.marker:g} mm do not fit into squares of "
                f"{1e3 * self.square:g} mm"
            )

    def board(self) -> Any:
        """Return OpenCV's board.

        Raises:
            SheetError: there are not so many markers.
        """
        if self.columns * self.rows // 2 > BOARD_MARKERS:
            raise SheetError(
                f"a board of {self.columns} x {self.rows} squares needs more than the "
                f"{BOARD_MARKERS} markers there are: take fewer squares"
            )
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows),
            self.square,
            self.marker,
            cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100),
        )


def add_board_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the measures of the board: the same options print it and find it."""
    default = BoardLayout()
    parser.add_argument("--columns", type=int, default=default.columns)
    parser.add_argument("--rows", type=int, default=default.rows)
    parser.add_argument("--square", type=float, default=default.square, help="edge in m")
    parser.add_argument("--marker", type=float, default=default.marker, help="edge in m")


def given_board(options: argparse.Namespace) -> BoardLayout:
    """Return the board that the options describe."""
    return BoardLayout(options.columns, options.rows, options.square, options.marker)


def tag_pages(tags: TagMap, paper: str = "a4") -> list[Page]:
    """Lay out every tag of a map, limb tags first.

    Raises:
        SheetError: a tag is larger than the paper.
    """
    width, height = PAPERS[paper]
    pages = [_new_page(width, height, "tags of the limb and around it")]
    x, y, row = _MARGIN, 24.0, 0.0
    entries = [
        (tag.id, tag.size, f"limb, {1e3 * tag.arc_length:.1f} mm from the clamp")
        for tag in tags.limb
    ]
    entries += [(tag.id, tag.size, "fixed") for tag in tags.world]
    for tag, size, note in entries:
        sheet = 1e3 * size * tags.family.sheet_cells / tags.family.border_cells
        step = max(sheet, 46.0) + 8.0
        if sheet > width - 2.0 * _MARGIN or sheet > height - 60.0:
            raise SheetError(f"tag {tag} of {1e3 * size:.0f} mm does not fit on {paper} paper")
        if x + step > width - _MARGIN + 8.0:
            x, y, row = _MARGIN, y + row, 0.0
        if y + sheet + 16.0 > height - 22.0:
            pages.append(_new_page(width, height, "tags of the limb and around it"))
            x, y, row = _MARGIN, 24.0, 0.0
        _add_tag(pages[-1], tags.family, tag, (1e3 * size, x, y), note)
        x += step
        row = max(row, sheet + 18.0)
    return pages


def board_page(layout: BoardLayout, paper: str = "a4") -> Page:
    """Lay out a calibration board, in landscape.

    Raises:
        SheetError: it does not fit, or its markers have no whole number of half millimetres a cell.
    """
    height, width = PAPERS[paper]
    across, down = 1e3 * layout.square * layout.columns, 1e3 * layout.square * layout.rows
    if across > width - 2.0 * _MARGIN or down > height - 40.0:
        raise SheetError(
            f"a board of {across:.0f} x {down:.0f} mm does not fit on {paper}: take fewer or "
            "smaller squares"
        )
    fine = 2  # pixels a millimetre
    if any(abs(v - round(v)) > 1e-6 for v in (1e3 * layout.square * fine, 1e3 * layout.marker / 3)):
        raise SheetError(
            "squares need a whole number of half millimetres, markers a multiple of 3 mm (6 cells)"
        )
    page = _new_page(width, height, f"calibration board, squares {1e3 * layout.square:.1f} mm")
    size = (round(across * fine), round(down * fine))
    image = layout.board().generateImage(size, marginSize=0, borderBits=1)
    for x, y, w, h in _black_rectangles(np.asarray(image) < 128):
        page.rectangles.append((_MARGIN + x / fine, 24.0 + y / fine, w / fine, h / fine))
    return page


def _new_page(width: float, height: float, title: str) -> Page:
    page = Page(width, height)
    page.labels.append((_MARGIN, 12.0, 4.0, f"{title} - print at 100 %, no scaling"))
    page.rectangles.append((_MARGIN, height - 14.0, 100.0, 1.0))
    for mark in range(11):
        page.rectangles.append((_MARGIN + 10.0 * mark - 0.1, height - 16.0, 0.2, 3.0))
    page.labels.append((_MARGIN + 104.0, height - 13.0, 3.5, "100 mm: check with a ruler"))
    return page


def _add_tag(
    page: Page, family: Family, tag: int, place: tuple[float, float, float], note: str
) -> None:
    """Add a tag, `place` being its size and its sheet's left and upper edges [mm]."""
    size, x, y = place
    cells = family.printed_cells(tag)
    cell = size / family.border_cells
    sheet = cell * family.sheet_cells
    left, top = (edge + 0.5 * (sheet - cell * len(cells)) for edge in (x, y))
    for column, row, w, h in _black_rectangles(cells == 0):
        page.rectangles.append((left + column * cell, top + row * cell, w * cell, h * cell))
    page.cuts.append((x, y, sheet, sheet))
    page.labels.append((x, y + sheet + 4.0, 3.2, f"{family.name} {tag}: {size:.1f} mm, {note}"))
    page.labels.append((x, y + sheet + 8.0, 2.6, "right-hand side: along the limb, or along x"))


def _black_rectangles(black: NDArray[np.bool_]) -> Iterable[tuple[int, int, int, int]]:
    """Cover the true cells of a grid by rectangles (column, row, width, height).

    They are the runs of each band of equal rows.
    """
    tops = np.flatnonzero(np.diff(black, axis=0, prepend=~black[:1]).any(axis=1))
    heights = np.diff(tops, append=len(black))
    bands, edges = np.nonzero(np.diff(np.pad(black[tops], ((0, 0), (1, 1)))))
    begins, widths, bands = edges[::2], edges[1::2] - edges[::2], bands[::2]
    columns = (begins, tops[bands], widths, heights[bands])
    return zip(*(column.tolist() for column in columns), strict=True)


def drawing(page: Page) -> Figure:
    """Return a page as a matplotlib figure of its true size, one unit of its axes being 1 mm."""
    figure = Figure(figsize=(page.width / _INCH, page.height / _INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, page.width), ylim=(page.height, 0.0))
    axes.set_axis_off()
    # One path: rectangles that touch are printed without a seam between them.
    axes.add_patch(PathPatch(_outline(page.rectangles), facecolor="black", linewidth=0.0))
    axes.add_patch(PathPatch(_outline(page.cuts), fill=False, edgecolor="0.73", linewidth=0.3))
    for x, y, size, text in page.labels:
        axes.text(x, y, text, fontsize=size * _POINTS, parse_math=False)
    return figure


def _outline(boxes: Sequence[tuple[float, float, float, float]]) -> MatplotlibPath:
    """Return rectangles (x, y, width, height) as one path."""
    corners = [((x, y), (x + w, y), (x + w, y + h), (x, y + h), (x, y)) for x, y, w, h in boxes]
    codes = [
        MatplotlibPath.MOVETO, *[MatplotlibPath.LINETO] * 3, MatplotlibPath.CLOSEPOLY
    ] * len(boxes)  # fmt: skip
    return MatplotlibPath(np.reshape(corners, (-1, 2)), codes)


def write_pdf(pages: Sequence[Page], path: Path) -> None:
    """Write pages as one PDF."""
    with PdfPages(path) as document:
        for page in pages:
            document.savefig(drawing(page))
