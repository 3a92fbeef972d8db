"""Sheets to print: tags of the limb, fixed tags and the calibration board, in true size.

A page is a list of black rectangles and labels in millimetres, written as SVG or PDF: both are
vectors, so that the edges of the tags are as straight as the printer is.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from apriltag_tracker import family
from apriltag_tracker.tag_map import TagMap

PAPERS = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}
_MARGIN = 12.0
_POINTS = 72.0 / 25.4


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

    def board(self) -> Any:
        """Return OpenCV's board.

        Raises:
            SheetError: there are too few squares, or the markers do not fit into them.
        """
        if min(self.columns, self.rows) < 2:
            raise SheetError(
                f"a board of {self.columns} x {self.rows} squares: take 2 or more each way"
            )
        if not 0.0 < self.marker < self.square:
            raise SheetError(
                f"markers of {1e3 * self.marker:g} mm do not fit into squares of "
                f"{1e3 * self.square:g} mm"
            )
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
        sheet = 1e3 * size * (family.BORDER_CELLS + 2) / family.BORDER_CELLS
        step = max(sheet, 46.0) + 8.0
        if sheet > width - 2.0 * _MARGIN or sheet > height - 60.0:
            raise SheetError(f"tag {tag} of {1e3 * size:.0f} mm does not fit on {paper} paper")
        if x + step > width - _MARGIN + 8.0:
            x, y, row = _MARGIN, y + row, 0.0
        if y + sheet + 16.0 > height - 22.0:
            pages.append(_new_page(width, height, "tags of the limb and around it"))
            x, y, row = _MARGIN, 24.0, 0.0
        _add_tag(pages[-1], tag, 1e3 * size, x, y, note)
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


def _add_tag(page: Page, tag: int, size: float, x: float, y: float, note: str) -> None:
    cells = family.printed_cells(tag, 1)
    cell = size / family.BORDER_CELLS
    for column, row, w, h in _black_rectangles(cells == 0):
        page.rectangles.append((x + column * cell, y + row * cell, w * cell, h * cell))
    sheet = cell * len(cells)
    page.cuts.append((x, y, sheet, sheet))
    page.labels.append((x, y + sheet + 4.0, 3.2, f"{tag}: {size:.1f} mm, {note}"))
    page.labels.append((x, y + sheet + 8.0, 2.6, "right-hand side: along the limb, or along x"))


def _black_rectangles(black: NDArray[np.bool_]) -> list[tuple[int, int, int, int]]:
    """Cover the true cells of a grid by rectangles: runs of a row, joined downward."""
    open_runs: dict[tuple[int, int], int] = {}
    result = []
    for row in range(black.shape[0] + 1):
        line = black[row] if row < black.shape[0] else np.zeros(black.shape[1], dtype=bool)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
        runs = {(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)}
        for run in [run for run in open_runs if run not in runs]:
            top = open_runs.pop(run)
            result.append((run[0], top, run[1] - run[0], row - top))
        for run in runs:
            open_runs.setdefault(run, row)
    return result


def write_svg(page: Page, path: Path) -> None:
    """Write one page as SVG."""
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{page.width}mm" height="{page.height}mm" '
        f'viewBox="0 0 {page.width} {page.height}" shape-rendering="crispEdges">',
        f'<rect width="{page.width}" height="{page.height}" fill="white"/>',
    ]
    lines += [
        f'<rect x="{x:.4f}" y="{y:.4f}" width="{w:.4f}" height="{h:.4f}"/>'
        for x, y, w, h in page.rectangles
    ]
    lines += [
        f'<rect x="{x:.4f}" y="{y:.4f}" width="{w:.4f}" height="{h:.4f}" fill="none" stroke="#bbb" '
        'stroke-width="0.1"/>'
        for x, y, w, h in page.cuts
    ]
    lines += [
        f'<text x="{x:.2f}" y="{y:.2f}" font-size="{size}" font-family="sans-serif">{text}</text>'
        for x, y, size, text in page.labels
    ]
    path.write_text("\n".join([*lines, "</svg>"]) + "\n")


def write_pdf(pages: Sequence[Page], path: Path) -> None:
    """Write pages as one PDF."""
    objects: list[bytes] = [b"<< /Type /Catalog /Pages 2 0 R >>", b""]
    objects.append(b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>")
    kids = []
    for page in pages:
        content = zlib.compress(_pdf_content(page).encode("latin-1"))
        stream = b"<< /Length %d /Filter /FlateDecode >>\nstream\n" % len(content)
        objects.append(stream + content + b"\nendstream")
        box = f"[0 0 {page.width * _POINTS:.4f} {page.height * _POINTS:.4f}]"
        objects.append(
            f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents {len(objects)} 0 R "
            "/Resources << /Font << /F1 3 0 R >> >> >>".encode()
        )
        kids.append(f"{len(objects)} 0 R")
    objects[1] = f"<< /Type /Pages /Kids [{' '.join(kids)}] /Count {len(kids)} >>".encode()
    body, places = b"%PDF-1.4\n", []
    for number, content in enumerate(objects, 1):
        places.append(len(body))
        body += b"%d 0 obj\n" % number + content + b"\nendobj\n"
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    body += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1) + table
    start = body.rindex(b"xref\n0 ")
    body += b"trailer\n<< /Size %d /Root 1 0 R >>\n" % (len(objects) + 1)
    path.write_bytes(body + b"startxref\n%d\n%%%%EOF\n" % start)


def _pdf_content(page: Page) -> str:
    """Return the drawing of a page; y runs upward in PDF, so the page is turned over."""
    scale = _POINTS
    lines = [f"{scale:.6f} 0 0 {-scale:.6f} 0 {page.height * scale:.6f} cm", "0 g"]
    lines += [f"{x:.4f} {y:.4f} {w:.4f} {h:.4f} re" for x, y, w, h in page.rectangles]
    lines += ["f", "0.73 G 0.1 w"]
    lines += [f"{x:.4f} {y:.4f} {w:.4f} {h:.4f} re" for x, y, w, h in page.cuts]
    lines.append("S")
    for x, y, size, text in page.labels:
        escaped = text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
        lines.append(f"BT /F1 1 Tf {size:.2f} 0 0 {-size:.2f} {x:.3f} {y:.3f} Tm ({escaped}) Tj ET")
    return "\n".join(lines)


def rasterise(page: Page, dots_per_mm: float) -> NDArray[np.uint8]:
    """Return a page as a grey image, for looking at it and for tests."""
    size = (round(page.height * dots_per_mm), round(page.width * dots_per_mm))
    image = np.full(size, 255, dtype=np.uint8)
    for x, y, w, h in page.rectangles:
        left, right = round(x * dots_per_mm), round((x + w) * dots_per_mm)
        top, bottom = round(y * dots_per_mm), round((y + h) * dots_per_mm)
        image[top:bottom, left:right] = 0
    return image
