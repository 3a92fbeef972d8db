"""The nearest path that a limb can follow, for a drawn path that leaves its reach."""

from der_planner.planning.nearest.path import Deviation, NearestPath, line, nearest_path

__all__ = ["Deviation", "NearestPath", "line", "nearest_path"]
