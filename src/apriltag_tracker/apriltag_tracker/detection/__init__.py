"""Finds tags in an image: candidates, their corners, their codes, and following them over time."""

from apriltag_tracker.detection.detector import Detector
from apriltag_tracker.detection.picture import grey
from apriltag_tracker.detection.quads import check_orientation

__all__ = ["Detector", "check_orientation", "grey"]
