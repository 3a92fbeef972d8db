"""Where the files of the package are once it is installed."""

from __future__ import annotations

from pathlib import Path

from ament_index_python.packages import get_package_share_directory

CONFIG = Path(get_package_share_directory("apriltag_tracker")) / "config"
"""The folder of the default maps and cameras."""
