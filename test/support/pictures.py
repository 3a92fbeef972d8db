"""Pictures as messages."""

from __future__ import annotations

import array

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from limb_interfaces.stamps import stamp_from_nanoseconds


def image_message(gray: NDArray[np.uint8], stamp: int = 0) -> Image:
    """Return a grey picture (rows, columns) as the message that a camera sends at a time [ns]."""
    high, wide = gray.shape
    message = Image(height=high, width=wide, step=wide, encoding="mono8")
    message.data = array.array("B", gray.tobytes())
    message.header.stamp = stamp_from_nanoseconds(stamp)
    return message
