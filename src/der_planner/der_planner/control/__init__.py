"""What is done about the error that a plan leaves: learning from run to run."""

from der_planner.control.disturbance import LearningError
from der_planner.control.learning import Learner, LearningRun

__all__ = ["Learner", "LearningError", "LearningRun"]
