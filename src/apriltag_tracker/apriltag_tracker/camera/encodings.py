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
_PLANAR = ("nv12", "nv21")
"""A plane of brightness with half as many rows of colour below it, which are not read."""

# A pattern is named by its first row in ROS and by its second row, second column on, in OpenCV.
_BAYER = {
    "bayer_rggb8": cv2.COLOR_BayerBG2GRAY,
    "bayer_bggr8": cv2.COLOR_BayerRG2GRAY,
    "bayer_gbrg8": cv2.COLOR_BayerGR2GRAY,
    "bayer_grbg8": cv2.COLOR_BayerGB2GRAY,
}
_BAYER_16 = {f"{name[:-1]}16": code for name, code in _BAYER.items()}
_MONO_16 = ("mono16", "16UC1")
KNOWN = ("mono8", "8UC1", *_MONO_16, *_TO_GREY, *_YUV_TO_GREY, *_PLANAR, *_BAYER, *_BAYER_16)


class ImageError(ValueError):
    """An image message cannot be read; the message says what came and what is expected."""


class ImageReader:
    """Reads the image messages of one camera.

    A camera of 10 or 12 bits sends them in words of 16, in the low or in the high bits. How many
    bits it has shows in the largest value so far, which therefore is remembered: an image that is
    darker than those before is dark.
    """

    def __init__(self) -> None:
        self._bits = 8

    def to_grey(
        self,
        data: Any,
        height: int,
        width: int,
        step: int,
        encoding: str,
        big_endian: bool = False,
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
                f"image of {width} x {height} px in {encoding} with {step} bytes a row has "
                f"{raw.size} bytes: {width * width_bytes} bytes a row or more expected"
            )
        rows = raw[: step * height].reshape(height, step)[:, : width * width_bytes]
        if encoding in {"mono8", "8UC1", *_PLANAR}:
            return np.ascontiguousarray(rows)
        if encoding in _YUV_TO_GREY:
            return np.ascontiguousarray(rows[:, _YUV_TO_GREY[encoding] :: 2])
        if encoding in {*_MONO_16, *_BAYER_16}:
            words = np.ascontiguousarray(rows).view(">u2" if big_endian else "<u2")
            grey = self._from_16_bits(words)
            return _from_bayer(grey, _BAYER_16[encoding]) if encoding in _BAYER_16 else grey
        if encoding in _BAYER:
            return _from_bayer(np.ascontiguousarray(rows), _BAYER[encoding])
        pixels = np.ascontiguousarray(rows).reshape(height, width, channels)
        return np.asarray(cv2.cvtColor(pixels, _TO_GREY[encoding]), dtype=np.uint8)

    def _from_16_bits(self, words: NDArray[Any]) -> NDArray[np.uint8]:
        """Return the upper 8 of as many bits as the camera has shown to use, 8 to 16."""
        used = int(words.max()).bit_length()
        self._bits = max(self._bits, min(2 * -(-used // 2), 16))
        return np.ascontiguousarray(words >> (self._bits - 8), dtype=np.uint8)


def to_grey(
    data: Any, height: int, width: int, step: int, encoding: str, big_endian: bool = False
) -> NDArray[np.uint8]:
    """Return the grey picture of one image message by itself, see `ImageReader.to_grey`."""
    return ImageReader().to_grey(data, height, width, step, encoding, big_endian)


def _from_bayer(mosaic: NDArray[np.uint8], code: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(mosaic, code), dtype=np.uint8)


def _layout(encoding: str) -> tuple[int, int]:
    """Return channels and bytes of a pixel."""
    if encoding in {"mono8", "8UC1", *_PLANAR, *_BAYER}:
        return 1, 1
    if encoding in {*_MONO_16, *_BAYER_16} or encoding in _YUV_TO_GREY:
        return 1, 2
    if encoding in _TO_GREY:
        channels = 4 if "a" in encoding else 3
        return channels, channels
    raise ImageError(f"unknown encoding '{encoding}': {', '.join(KNOWN)} are read")
