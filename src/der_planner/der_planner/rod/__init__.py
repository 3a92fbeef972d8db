"""The discrete elastic rod with explicit inputs.

`Rod` describes one rod and holds its compiled kernels; `RodState` is where it is; `Trajectory` is
where it went. All values are SI.
"""

from der_planner.rod.backend import ConvergenceError, RodState
from der_planner.rod.integration import Trajectory
from der_planner.rod.rod import Rod

__all__ = ["ConvergenceError", "Rod", "RodState", "Trajectory"]
