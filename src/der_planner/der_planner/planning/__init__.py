"""From a motion to timed pressures: motions, inverse kinematics, planners, plans.

`plan(limb, motion)` is the way in; `Motion.named` and `Motion.from_tip_path` make motions.
"""

from der_planner.model import CONTROL_PERIOD
from der_planner.planning.configuration import METHODS
from der_planner.planning.loads import BucklingError, OverloadError, PlanningError
from der_planner.planning.motions import NAMES, Motion, Reference
from der_planner.planning.obstacles import ObstacleError, Obstacles
from der_planner.planning.plan_file import Plan
from der_planner.planning.planner import choose_method, plan
from der_planner.planning.timing import PathLimits, Start
from der_planner.planning.workspace import UnreachableError, Workspace

__all__ = [
    "CONTROL_PERIOD",
    "METHODS",
    "NAMES",
    "BucklingError",
    "Motion",
    "ObstacleError",
    "Obstacles",
    "OverloadError",
    "PathLimits",
    "Plan",
    "PlanningError",
    "Reference",
    "Start",
    "UnreachableError",
    "Workspace",
    "choose_method",
    "plan",
]
