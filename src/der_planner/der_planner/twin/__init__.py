"""The simulated limb that stands in for the hardware."""
