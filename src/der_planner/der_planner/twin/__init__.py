"""The simulated limb that stands in for the hardware."""

from der_planner.twin.limb_twin import LimbTwin, TwinError, TwinShape
from der_planner.twin.loads import Push

__all__ = ["LimbTwin", "Push", "TwinError", "TwinShape"]
