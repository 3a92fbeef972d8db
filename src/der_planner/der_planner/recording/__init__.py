"""Bags that survive a kill."""
