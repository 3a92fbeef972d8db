"""Recorded runs: bags written, read and repaired (`recording`), and their errors (`evaluation`)."""
