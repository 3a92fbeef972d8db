"""Numbers of many messages, kept as numbers: 8 bytes each, however long the bag."""

from __future__ import annotations

from array import array
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from der_planner.bags.run import Array


class Columns:
    """Rows of a stamp [ns] and some numbers, appended one by one.

    The first row that is not empty fixes the width; a row of another width becomes NaN (a board
    that has not measured yet, a limb that was not seen).
    """

    def __init__(self, width: int = 0) -> None:
        self._stamps = array("q")
        self._values = array("d")
        self._width = width

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def width(self) -> int:
        """Numbers in a row; 0 before the first row that is not empty."""
        return self._width

    def append(self, stamp: int, values: Sequence[float] | Array) -> None:
        """Add a row."""
        if self._width == 0 and len(values):
            self._width = len(values)
            self._values.extend([float("nan")] * (self._width * len(self._stamps)))
        self._stamps.append(stamp)
        if len(values) == self._width:
            self._values.extend(float(value) for value in values)
        else:
            self._values.extend([float("nan")] * self._width)

    def stamps(self) -> NDArray[np.int64]:
        """Return (N,) stamps [ns]."""
        return np.array(self._stamps, dtype=np.int64)

    def values(self, width: int) -> Array:
        """Return (N, width) numbers; NaN throughout where rows had another width."""
        if self._width != width:
            return np.full((len(self), width), np.nan)
        return np.array(self._values, dtype=float).reshape(-1, width)
