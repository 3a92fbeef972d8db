"""From a motion to timed pressures."""
