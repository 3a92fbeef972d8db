"""The piecewise-constant-curvature baseline: kinematics and dynamics of n segments."""

from der_planner.pcc.linearisation import Linearisation
from der_planner.pcc.model import Pcc

__all__ = ["Linearisation", "Pcc"]
