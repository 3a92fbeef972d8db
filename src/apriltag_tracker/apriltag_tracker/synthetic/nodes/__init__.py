"""Nodes that show the shape of the twin."""
