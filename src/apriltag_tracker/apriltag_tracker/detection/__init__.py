"""Finds tags in an image: candidates, their corners, their codes, and following them over time."""

from apriltag_tracker.detection.detector import Detector, Tag

__all__ = ["Detector", "Tag"]
