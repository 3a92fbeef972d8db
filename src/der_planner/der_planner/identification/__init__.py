"""From logs to a limb file: excitation, fits, reports, and checks of later runs."""

from der_planner.identification.excitation import calibrate_twin, record_twin
from der_planner.identification.fit import fit
from der_planner.identification.log import CalibrationLog, LogError
from der_planner.identification.readers import ColumnMap, read_bag, read_csv, read_log
from der_planner.identification.report import FitReport, check, predict
from der_planner.identification.update import update

__all__ = [
    "CalibrationLog",
    "ColumnMap",
    "FitReport",
    "LogError",
    "calibrate_twin",
    "check",
    "fit",
    "predict",
    "read_bag",
    "read_csv",
    "read_log",
    "record_twin",
    "update",
]
