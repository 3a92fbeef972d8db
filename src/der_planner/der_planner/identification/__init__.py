"""From logs to a limb file."""
