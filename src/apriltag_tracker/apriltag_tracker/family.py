"""The tag family 36h11: what a printed tag looks like, and how OpenCV's copy of it is turned."""

from __future__ import annotations

import functools
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

BORDER_CELLS = 8
"""Cells along the edge of the black border; `size` of a tag means these."""

CODE_CELLS = 6
FAMILY = "tag36h11"
TAG_COUNT = 587

_CODE_OF_TAG_0 = 0xD5D628584
"""Bits of the printed tag 0, row by row from its upper left: the family's own published code."""


class FamilyError(RuntimeError):
    """OpenCV's dictionary or detector does not behave as this package needs it to."""


@functools.cache
def dictionary() -> Any:
    """Return OpenCV's dictionary of the family."""
    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)


@functools.cache
def codes() -> NDArray[np.uint8]:
    """Return the white (1) and black (0) inner cells of all printed tags, (587, 6, 6).

    Row 0 is the upper row of the printed tag. OpenCV stores the codes turned by half a turn.
    """
    table = np.empty((TAG_COUNT, CODE_CELLS, CODE_CELLS), dtype=np.uint8)
    known = dictionary()
    for tag in range(TAG_COUNT):
        stored = cv2.aruco.generateImageMarker(known, tag, BORDER_CELLS)
        table[tag] = np.rot90(stored[1:-1, 1:-1] > 0, 2)
    return table


def printed_cells(tag: int, margin: int = 1) -> NDArray[np.uint8]:
    """Return the cells of one printed tag with its black border and white margin.

    Args:
        tag: id within the family.
        margin: width of the white margin in cells.

    Returns:
        (8 + 2 margin, 8 + 2 margin) array of 0 (black) and 1 (white), upper row first.

    Raises:
        ValueError: no such tag in the family.
    """
    if not 0 <= tag < TAG_COUNT:
        raise ValueError(f"tag id {tag}: {FAMILY} has 0 to {TAG_COUNT - 1}")
    cells = np.ones((BORDER_CELLS + 2 * margin,) * 2, dtype=np.uint8)
    cells[margin : margin + BORDER_CELLS, margin : margin + BORDER_CELLS] = 0
    inner = slice(margin + 1, margin + 1 + CODE_CELLS)
    cells[inner, inner] = codes()[tag]
    return cells


def check_code_of_tag_0() -> None:
    """Compare tag 0 of OpenCV's dictionary with the family's published code.

    Raises:
        FamilyError: they differ, so every yaw would be wrong.
    """
    bits = codes()[0].ravel()
    value = int("".join(str(bit) for bit in bits), 2)
    if value != _CODE_OF_TAG_0:
        raise FamilyError(
            f"tag 0 of OpenCV {cv2.__version__} reads {value:#x} and not {_CODE_OF_TAG_0:#x}: its "
            "dictionary is turned in another way than this package knows; install "
            "opencv-python-headless 4.14 or 5.0"
        )
