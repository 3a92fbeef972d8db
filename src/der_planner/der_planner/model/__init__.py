"""One limb as a model: its air, its material, and the rod or the arcs that bend under them.

`Model.of(limb, "der")` is built once and passed; `simulate` rolls it forward.
"""

from der_planner.model.arcs import ArcModel
from der_planner.model.material import Material
from der_planner.model.model import NODES, AnyModel, Model, State
from der_planner.model.rod import RodModel
from der_planner.model.simulation import CONTROL_PERIOD, STEPS, Initial, Response, simulate

__all__ = [
    "CONTROL_PERIOD",
    "NODES",
    "STEPS",
    "AnyModel",
    "ArcModel",
    "Initial",
    "Material",
    "Model",
    "Response",
    "RodModel",
    "State",
    "simulate",
]
