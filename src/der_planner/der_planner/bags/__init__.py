"""Bags: written by the recorder, read, recovered, replayed, and turned into arrays."""
