"""The nearest path that a limb can follow, for a path that leaves what it reaches."""

from der_planner.planning.nearest.path import Deviation, NearestPath, line, nearest_path

__all__ = ["Deviation", "NearestPath", "line", "nearest_path"]
