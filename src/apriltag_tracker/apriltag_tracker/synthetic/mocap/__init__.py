"""The node that tells the poses of the twin."""
