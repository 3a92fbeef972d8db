"""From logs to a limb file: excitation, fits, reports, and checks of later runs."""

from der_planner.identification.fit import fit
from der_planner.identification.log import CalibrationLog, LogError
from der_planner.identification.offline import calibrate_twin, record_twin
from der_planner.identification.report import FitReport, Unknown

__all__ = [
    "CalibrationLog",
    "FitReport",
    "LogError",
    "Unknown",
    "calibrate_twin",
    "fit",
    "record_twin",
]
