"""Tag families: what a printed tag looks like, and how OpenCV's copy of the family is turned.

OpenCV knows the codes of the square families. Those of the standard families, whose cells lie on
both sides of a white border, are in `data/standard_families.npz`: the codes of the AprilTag 3
library (BSD licence beside it), cell by cell in rows.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

_STANDARD_CODES = Path(__file__).parent / "data" / "standard_families.npz"


@dataclass(frozen=True)
class Family:
    """A family of tags with a border one cell wide around a square code.

    The border is black on white. With an outer ring it is white on black, and beyond the black
    cells around it lies one more ring of cells that belong to the code. Such tags are read in the
    negative of a picture, where they have a black border like the others.

    Attributes:
        name: as the AprilTag library calls it.
        code_cells: cells along the edge of the code inside of the border.
        tag_count: how many tags there are.
        correct_bits: wrong cells of a code that are forgiven in a search, if nothing else is said.
        most_corrected: the same at most: with more, pictures without a tag show some.
        largest_misfit: RMS distance of the cells from plain black and white above which a code is
            not believed [half contrasts]; the shorter a code, the smaller it is.
        dictionary_id: OpenCV's number of the family, None if it has none.
    """

    name: str
    code_cells: int
    tag_count: int
    correct_bits: int
    most_corrected: int
    largest_misfit: float
    dictionary_id: int | None

    @property
    def outer_ring(self) -> bool:
        """Whether cells around the border belong to the code, and the border is white."""
        return self.dictionary_id is None

    @property
    def border_cells(self) -> int:
        """Cells along the edge of the border, which `size` of a tag means."""
        return self.code_cells + 2

    @property
    def rim(self) -> int:
        """Cells around the border that belong to the tag: its margin, and an outer ring."""
        return 1 + int(self.outer_ring)

    @property
    def tag_cells(self) -> int:
        """Cells along the edge of the tag with its rim."""
        return self.border_cells + 2 * self.rim

    @property
    def sheet_cells(self) -> float:
        """Cells along the edge of the sheet: half a one more on each side of an outer ring."""
        return self.tag_cells + float(self.outer_ring)

    def rings(self) -> NDArray[np.int64]:
        """Tell in which ring each cell of a tag with its rim is, (n, n): 0 is the border."""
        across = np.arange(self.tag_cells)
        inward = np.minimum(across, across[::-1]) - self.rim
        return np.asarray(np.minimum(inward[:, None], inward[None, :]))

    def code_mask(self) -> NDArray[np.bool_]:
        """Tell which cells of a tag with its rim belong to the code, (n, n)."""
        rings = self.rings()
        return np.asarray((rings >= 1) | (rings <= -2))

    def codes(self) -> NDArray[np.uint8]:
        """Return the white (1) and black (0) code cells of all printed tags, (tags, cells).

        The cells are those of `code_mask`, row by row from the upper left of the printed tag.
        """
        return _codes(self)

    def printed_cells(self, tag: int) -> NDArray[np.uint8]:
        """Return the cells of one printed tag with its rim.

        Args:
            tag: id within the family.

        Returns:
            (tag_cells,) * 2 array of 0 (black) and 1 (white), upper row first.

        Raises:
            ValueError: no such tag in the family.
        """
        if not 0 <= tag < self.tag_count:
            raise ValueError(f"tag id {tag}: {self.name} has 0 to {self.tag_count - 1}")
        mask = self.code_mask()
        inside = np.s_[self.rim : -self.rim, self.rim : -self.rim]
        cells = np.full(mask.shape, 0 if self.outer_ring else 1, dtype=np.uint8)
        cells[inside] = 1 if self.outer_ring else 0
        cells[mask] = self.codes()[tag]
        return cells


@functools.cache
def _codes(family: Family) -> NDArray[np.uint8]:
    if family.dictionary_id is None:
        count = int(family.code_mask().sum())
        with np.load(_STANDARD_CODES) as tables:
            packed = tables[family.name]
        return np.unpackbits(packed, axis=1, count=count)
    table = np.empty((family.tag_count, family.code_cells**2), dtype=np.uint8)
    known = cv2.aruco.getPredefinedDictionary(family.dictionary_id)
    for tag in range(family.tag_count):
        stored = cv2.aruco.generateImageMarker(known, tag, family.border_cells)
        # OpenCV stores the codes turned by half a turn.
        table[tag] = np.rot90(stored[1:-1, 1:-1] > 0, 2).ravel()
    return table


_STRONG, _CLEAR = 0.6, 0.35

_ALL = (
    Family("tag36h11", 6, 587, 1, 2, _STRONG, cv2.aruco.DICT_APRILTAG_36h11),
    Family("tag36h10", 6, 2320, 1, 1, _STRONG, cv2.aruco.DICT_APRILTAG_36h10),
    Family("tag25h9", 5, 35, 0, 1, _CLEAR, cv2.aruco.DICT_APRILTAG_25h9),
    Family("tag16h5", 4, 30, 0, 0, _CLEAR, cv2.aruco.DICT_APRILTAG_16h5),
    Family("tagStandard41h12", 3, 2115, 2, 2, _STRONG, None),
    Family("tagStandard52h13", 4, 48714, 3, 4, _STRONG, None),
)

FAMILIES = {family.name: family for family in _ALL}
TAG36H11 = FAMILIES["tag36h11"]


def named(name: object) -> Family:
    """Return the family of a name.

    Raises:
        ValueError: it is none of those that are read here; the message names them.
    """
    if isinstance(name, str) and name in FAMILIES:
        return FAMILIES[name]
    raise ValueError(f"family '{name}' is not read here: there are {', '.join(FAMILIES)}")
