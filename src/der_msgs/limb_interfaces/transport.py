"""The transport that camera images need, chosen before ROS starts."""

from __future__ import annotations

import contextlib
import ctypes
import os
from pathlib import Path

PROFILE = Path("share/apriltag_tracker/config/fastdds_large_images.xml")
"""Below the prefix into which `apriltag_tracker` is installed."""
_SETTINGS = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""Environment variables that name a profile of Fast DDS."""
_LOCAL = "DEFAULT_FASTRTPS_PROFILES.xml"
"""File in the working folder that Fast DDS reads where no variable names another."""

_THRESHOLDS = (-1, -3)
"""Settings M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of `malloc.h` of the GNU C library."""
_KEPT = 64 << 20
"""Memory that a process keeps for its next messages [bytes]."""


def keep_buffers() -> bool:
    """Have the memory of a message kept for the next one, instead of given back and asked for anew.

    The C library gives an image's memory back to the kernel with every message, and the next one
    then faults once a page: 1.4 of the 2.6 ms of CPU of receiving an image of 1280 x 720.

    Returns:
        Whether the C library has such a setting.
    """
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        return all(library.mallopt(key, _KEPT) for key in _THRESHOLDS)
    return False


def use_large_messages() -> Path | None:
    """Make Fast DDS carry camera images within the machine, unless somebody has set it up already.

    With its own defaults more than half of all 720p images are lost without a word. It must be
    called before rclpy is initialised.

    Returns:
        The profile that was set; None if another is set already, or none is installed.
    """
    if any(os.environ.get(name) for name in _SETTINGS) or Path(_LOCAL).exists():
        return None
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        profile = Path(prefix) / PROFILE
        if prefix and profile.is_file():
            os.environ[_SETTINGS[0]] = str(profile)
            return profile
    return None
