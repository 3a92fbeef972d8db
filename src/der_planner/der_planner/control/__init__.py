"""Corrections of the error that a plan leaves: learning between runs, feedback within a run."""

from der_planner.control.disturbance import LearningError
from der_planner.control.feedback import Feedback
from der_planner.control.learning import Learner

__all__ = ["Feedback", "Learner", "LearningError"]
