"""Plays timed pressure setpoints on a valve board at 20 Hz, and vents the limb on any failure."""
