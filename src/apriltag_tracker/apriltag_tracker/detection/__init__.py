"""Finds tags in an image: candidates, their corners, their codes, and following them over time."""

from apriltag_tracker.detection.detector import SMALLEST_TAG, Detector, Tag

__all__ = ["SMALLEST_TAG", "Detector", "Tag"]
