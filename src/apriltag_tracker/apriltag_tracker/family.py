"""Tag families: what a printed tag looks like, and how OpenCV's copy of the family is turned."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


class FamilyError(RuntimeError):
    """OpenCV's dictionary or detector does not behave as this package needs it to."""


@dataclass(frozen=True)
class Family:
    """A family of tags with a black border one cell wide around a square code.

    Attributes:
        name: as the AprilTag library calls it.
        code_cells: cells along the edge of the code.
        tag_count: how many tags there are.
        hamming: cells in which any two codes differ at least, however they are turned.
        first_code: bits of the printed tag 0, row by row from its upper left, as published.
        correct_bits: wrong cells of a code that are forgiven in a search, if nothing else is said.
        most_corrected: the same at most: with more, pictures without a tag show some.
        explained: share of the pixels' variance above which a pattern is a tag's. A pattern with so
            many other cells that it is not forgiven explains less, however sharp the picture is.
        needs_pattern: the code alone is too weak: the whole pattern must explain the picture, too.
        dictionary_id: OpenCV's number of the family.
    """

    name: str
    code_cells: int
    tag_count: int
    hamming: int
    first_code: int
    correct_bits: int
    most_corrected: int
    explained: float
    needs_pattern: bool
    dictionary_id: int

    @property
    def border_cells(self) -> int:
        """Cells along the edge of the black border; `size` of a tag means these."""
        return self.code_cells + 2

    @property
    def most_wrong(self) -> int:
        """Wrong cells up to which only one tag can be meant."""
        return (self.hamming - 1) // 2

    def dictionary(self) -> Any:
        """Return OpenCV's dictionary of the family."""
        return cv2.aruco.getPredefinedDictionary(self.dictionary_id)

    def codes(self) -> NDArray[np.uint8]:
        """Return the white (1) and black (0) inner cells of all printed tags, (tags, n, n).

        Row 0 is the upper row of the printed tag. OpenCV stores the codes turned by half a turn.
        """
        return _codes(self)

    def printed_cells(self, tag: int, margin: int = 1) -> NDArray[np.uint8]:
        """Return the cells of one printed tag with its black border and white margin.

        Args:
            tag: id within the family.
            margin: width of the white margin in cells.

        Returns:
            (border_cells + 2 margin,) * 2 array of 0 (black) and 1 (white), upper row first.

        Raises:
            ValueError: no such tag in the family.
        """
        if not 0 <= tag < self.tag_count:
            raise ValueError(f"tag id {tag}: {self.name} has 0 to {self.tag_count - 1}")
        cells = np.ones((self.border_cells + 2 * margin,) * 2, dtype=np.uint8)
        cells[margin : margin + self.border_cells, margin : margin + self.border_cells] = 0
        inner = slice(margin + 1, margin + 1 + self.code_cells)
        cells[inner, inner] = self.codes()[tag]
        return cells

    def enlarged_tag(self, tag: int, scale: int) -> NDArray[np.uint8]:
        """Return a perfect picture of a tag without its margin, `scale` px a cell, of 0 and 255."""
        cells = self.printed_cells(tag, margin=0) * np.uint8(255)
        return np.repeat(np.repeat(cells, scale, axis=0), scale, axis=1)

    def check_code_of_tag_0(self) -> None:
        """Compare tag 0 of OpenCV's dictionary with the family's published code.

        Raises:
            FamilyError: they differ, so every yaw would be wrong.
        """
        bits = self.codes()[0].ravel()
        value = int("".join(str(bit) for bit in bits), 2)
        if value != self.first_code:
            raise FamilyError(
                f"tag 0 of {self.name} in OpenCV {cv2.__version__} reads {value:#x} and not "
                f"{self.first_code:#x}: its dictionary is turned in another way than this package "
                "knows; install opencv-python-headless 4.14 or 5.0"
            )


@functools.cache
def _codes(family: Family) -> NDArray[np.uint8]:
    size = family.code_cells
    table = np.empty((family.tag_count, size, size), dtype=np.uint8)
    known = family.dictionary()
    for tag in range(family.tag_count):
        stored = cv2.aruco.generateImageMarker(known, tag, family.border_cells)
        table[tag] = np.rot90(stored[1:-1, 1:-1] > 0, 2)
    return table


_ALL = (
    Family("tag36h11", 6, 587, 11, 0xD5D628584, 1, 2, 0.93, False, cv2.aruco.DICT_APRILTAG_36h11),
    Family("tag36h10", 6, 2320, 10, 0x1CA92A687, 1, 1, 0.93, False, cv2.aruco.DICT_APRILTAG_36h10),
    Family("tag25h9", 5, 35, 9, 0x155CBF1, 0, 1, 0.955, True, cv2.aruco.DICT_APRILTAG_25h9),
    Family("tag16h5", 4, 30, 5, 0x231B, 0, 0, 0.95, True, cv2.aruco.DICT_APRILTAG_16h5),
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
    there = ", ".join(FAMILIES)
    why = ""
    if isinstance(name, str) and name.lower().startswith(("tagstandard", "tagcircle", "tagcustom")):
        why = "its tags have cells outside of their border, which nothing here reads; "
    raise ValueError(f"family '{name}': {why}there are {there}")
