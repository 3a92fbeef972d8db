"""What is done about the error that a plan leaves: learning from run to run."""

from der_planner.control.learning import Learner, LearningError, LearningRun

__all__ = ["Learner", "LearningError", "LearningRun"]
