"""The camera's picture for browsers: JPEG, as fast and as large as they show it, if they look."""

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
WIDTHS = (320, 480, 640, 960)
"""[px] to which a picture is made smaller for a window that shows no more."""
STRETCH = 0.85
"""Least width of a picture over that at which it is shown."""


class PictureError(RuntimeError):
    """A picture cannot be encoded."""


@dataclass(frozen=True)
class Encoded:
    """A picture ready to be sent.

    Attributes:
        number: counts the pictures from 1.
        stamp: of the image [ns].
        size: width and height of the camera's image [px]; the file may be smaller.
        jpeg: the file.
    """

    number: int
    stamp: int
    size: tuple[int, int]
    jpeg: bytes


class PictureFeed:
    """Keeps the newest picture; encodes it once for all browsers that show it about as large.

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
        self._encoded: dict[int, Encoded] = {}
        self.on_put: Callable[[], None] = lambda: None
        """Called, from the thread that puts it, when a picture has come."""

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
            self._encoded.clear()
        self.on_put()

    def look(self, after: int) -> bool:
        """Tell whether there is a picture other than number ``after``; counts as looking."""
        self._asked = self._clock()
        return self._raw is not None and self._number != after

    def take(self, after: int, shown: int = 0) -> Encoded | None:
        """Return the newest picture, None if it is number ``after``.

        Args:
            after: number of the one that is known.
            shown: width at which it is shown [px], which may make it smaller; 0: as it is.

        Raises:
            PictureError: OpenCV cannot encode it.
        """
        if not self.look(after):
            return None
        with self._lock:
            assert self._raw is not None
            stamp, grey = self._raw
            width = width_for(grey.shape[1], shown)
            if width not in self._encoded:
                size = (grey.shape[1], grey.shape[0])
                jpeg = _encode(grey, width, self._quality)
                self._encoded[width] = Encoded(self._number, stamp, size, jpeg)
            return self._encoded[width]


def width_for(full: int, shown: int) -> int:
    """Return the width [px] of the file for a picture of a full width that is shown at another."""
    if shown <= 0:
        return full
    return min((width for width in WIDTHS if STRETCH * shown <= width < full), default=full)


def _encode(grey: NDArray[np.uint8], width: int, quality: int) -> bytes:
    height, full = grey.shape
    if width < full:
        size = (width, max(1, round(height * width / full)))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise PictureError("OpenCV cannot encode the picture as JPEG")
    return data.tobytes()
