"""Pixels of a `sensor_msgs/Image` as a grey array, without copying where that is possible."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_TO_GREY = {
    "bgr8": cv2.COLOR_BGR2GRAY,
    "rgb8": cv2.COLOR_RGB2GRAY,
    "bgra8": cv2.COLOR_BGRA2GRAY,
    "rgba8": cv2.COLOR_RGBA2GRAY,
}
_YUV_TO_GREY = {"yuv422_yuy2": 0, "yuyv": 0, "yuv422": 1, "uyvy": 1}
KNOWN = ("mono8", "8UC1", "mono16", "16UC1", *_TO_GREY, *_YUV_TO_GREY)


class ImageError(ValueError):
    """An image message cannot be read; the message says what came and what is expected."""


def to_grey(
    data: Any, height: int, width: int, step: int, encoding: str, big_endian: bool = False
) -> NDArray[np.uint8]:
    """Return the grey picture of an image message.

    Args:
        data: bytes of the message.
        height: rows.
        width: columns.
        step: bytes from row to row.
        encoding: as named by `sensor_msgs/image_encodings`.
        big_endian: of 16-bit pixels.

    Raises:
        ImageError: unknown encoding, or fewer bytes than the size needs.
    """
    channels, width_bytes = _layout(encoding)
    raw = np.frombuffer(data, dtype=np.uint8)
    if height <= 0 or width <= 0 or step < width * width_bytes or raw.size < step * height:
        raise ImageError(
            f"image of {width} x {height} px in {encoding} with {step} bytes a row has {raw.size} "
            f"bytes: {width * width_bytes} bytes a row or more expected"
        )
    rows = raw[: step * height].reshape(height, step)[:, : width * width_bytes]
    if encoding in {"mono8", "8UC1"}:
        return np.ascontiguousarray(rows)
    if encoding in {"mono16", "16UC1"}:
        return np.ascontiguousarray(rows[:, 0 if big_endian else 1 :: 2])
    if encoding in _YUV_TO_GREY:
        return np.ascontiguousarray(rows[:, _YUV_TO_GREY[encoding] :: 2])
    pixels = np.ascontiguousarray(rows).reshape(height, width, channels)
    return np.asarray(cv2.cvtColor(pixels, _TO_GREY[encoding]), dtype=np.uint8)


def _layout(encoding: str) -> tuple[int, int]:
    """Return channels and bytes of a pixel."""
    if encoding in {"mono8", "8UC1"}:
        return 1, 1
    if encoding in {"mono16", "16UC1"} or encoding in _YUV_TO_GREY:
        return 1, 2
    if encoding in _TO_GREY:
        channels = 4 if "a" in encoding else 3
        return channels, channels
    raise ImageError(f"unknown encoding '{encoding}': {', '.join(KNOWN)} are read")
