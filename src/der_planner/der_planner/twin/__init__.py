"""The simulated limb that stands in for the hardware."""

from der_planner.twin.body import Push, TwinError
from der_planner.twin.limb_twin import LimbTwin

__all__ = ["LimbTwin", "Push", "TwinError"]
