"""Finds tags in an image: candidates, their corners, their codes, and following them over time."""

from apriltag_tracker.detection.detector import (
    MOST_CORRECTED_BITS,
    Detector,
    check_orientation,
    enlarged_tag,
    grey,
)

__all__ = ["MOST_CORRECTED_BITS", "Detector", "check_orientation", "enlarged_tag", "grey"]
