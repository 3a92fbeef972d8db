"""What stops a study before or while it is played; a failed run does not."""

from __future__ import annotations


class StudyError(RuntimeError):
    """A study cannot be read, played or kept; the message names the thing and the remedy."""
