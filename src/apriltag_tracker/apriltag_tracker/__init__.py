"""Finds the tip and the shape of a soft limb from the AprilTags on it."""
