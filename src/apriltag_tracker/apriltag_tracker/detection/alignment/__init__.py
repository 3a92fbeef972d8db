"""Fits the printed pattern of a tag to its pixels, with blur and smear of the camera."""
