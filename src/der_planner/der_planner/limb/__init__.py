"""One robot: each of its parameters declared once, what loads it, and its file."""

from der_planner.limb.declaration import LimbError, Parameter, Term, declarations
from der_planner.limb.limb import DEFAULT_LIMB_FILE, Limb
from der_planner.limb.loads import (
    BEYOND_THE_TIP,
    GRAVITY,
    HEAVIEST,
    MOUNTINGS,
    PAYLOAD,
    Load,
    PointMass,
    gravity_of,
    mounting_of,
)
from der_planner.limb.parameters import VENT_REFERENCE, CalibratedRange, Pneumatics, Segment

__all__ = [
    "BEYOND_THE_TIP",
    "DEFAULT_LIMB_FILE",
    "GRAVITY",
    "HEAVIEST",
    "MOUNTINGS",
    "PAYLOAD",
    "VENT_REFERENCE",
    "CalibratedRange",
    "Limb",
    "LimbError",
    "Load",
    "Parameter",
    "Pneumatics",
    "PointMass",
    "Segment",
    "Term",
    "declarations",
    "gravity_of",
    "mounting_of",
]
