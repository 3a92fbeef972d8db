"""What is done about the error that a plan leaves: feedback within a run."""

from der_planner.control.feedback import Feedback

__all__ = ["Feedback"]
