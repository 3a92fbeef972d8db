"""A picture as it is searched: grey, and dim or not."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_DIM = 60.0
"""A picture whose grey levels span less is dim."""


def grey(image: Any) -> NDArray[np.uint8]:
    """Check an image and return it as contiguous grey.

    Raises:
        ValueError: not an array of uint8 with one or three channels.
    """
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim not in {2, 3}:
        what = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image)
        raise ValueError(
            f"image: uint8 array (rows, columns) or (rows, columns, 3) expected, not {what}"
        )
    if image.size == 0:
        raise ValueError(f"image: the picture is empty ({image.shape[1]} x {image.shape[0]} px)")
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.ascontiguousarray(image)


def is_dim(image: NDArray[np.uint8]) -> bool:
    """Tell from 1 pixel of 64 whether nothing stands out against OpenCV's usual threshold."""
    low, high = np.percentile(image[::8, ::8], (1.0, 99.0))
    return bool(high - low < _DIM)
