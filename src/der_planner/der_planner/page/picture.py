"""The camera's picture for browsers: JPEG, no faster than asked for, and only if somebody looks."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

LOOKING = 2.0
"""[s] after the last request during which somebody counts as looking."""


class PictureError(RuntimeError):
    """A picture cannot be encoded."""


@dataclass(frozen=True)
class Encoded:
    """A picture ready to be sent.

    Attributes:
        number: counts the pictures from 1.
        stamp: of the image [ns].
        jpeg: the file.
    """

    number: int
    stamp: int
    jpeg: bytes


class PictureFeed:
    """Keeps the newest picture and encodes it once, when the first browser asks for it.

    Args:
        rate: pictures a second at most.
        quality: of the JPEG, 1 to 100.
        clock: steady [s].
    """

    def __init__(
        self, rate: float, quality: int = 80, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._interval = 1.0 / rate
        self._quality = quality
        self._clock = clock
        self._lock = threading.Lock()
        self._asked = -np.inf
        self._due = -np.inf
        self._number = 0
        self._raw: tuple[int, NDArray[np.uint8]] | None = None
        self._encoded: Encoded | None = None

    @property
    def watched(self) -> bool:
        """Whether somebody has asked for a picture lately."""
        return self._clock() - self._asked <= LOOKING

    def due(self) -> bool:
        """Tell whether the image that has just come should be put in; keeps the rate."""
        now = self._clock()
        if not self.watched or now < self._due:
            return False
        # On a grid, so that cameras of 30 Hz give 15 Hz and not 10.
        self._due = max(self._due + self._interval, now + 0.5 * self._interval)
        return True

    def put(self, stamp: int, grey: NDArray[np.uint8]) -> None:
        """Keep a picture (H, W) of an instant [ns] for whoever asks next."""
        with self._lock:
            self._number += 1
            self._raw = (stamp, grey)

    def take(self, after: int) -> Encoded | None:
        """Return the newest picture, None if it is not newer than number ``after``.

        Raises:
            PictureError: OpenCV cannot encode it.
        """
        self._asked = self._clock()
        with self._lock:
            if self._raw is None or self._number == after:
                return None
            if self._encoded is None or self._encoded.number != self._number:
                done, data = cv2.imencode(
                    ".jpg", self._raw[1], [cv2.IMWRITE_JPEG_QUALITY, self._quality]
                )
                if not done:
                    raise PictureError("OpenCV cannot encode the picture as JPEG")
                self._encoded = Encoded(self._number, self._raw[0], data.tobytes())
            return self._encoded
