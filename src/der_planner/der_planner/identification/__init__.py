"""From logs to a limb file: excitation, fits, reports, and checks of later runs."""

from der_planner.identification.bends import GROUPS
from der_planner.identification.excitation import (
    Excitation,
    calibrate_twin,
    calibration_run,
    read_excitation,
    record_twin,
    within_limits,
    write_excitation,
)
from der_planner.identification.fit import fit
from der_planner.identification.log import CalibrationLog, LogError, prepare
from der_planner.identification.readers import ColumnMap, read_bag, read_csv, read_log
from der_planner.identification.report import (
    Check,
    FitReport,
    Unknown,
    check,
    plot_prediction,
    predict,
)
from der_planner.identification.update import Change, Update, update

__all__ = [
    "GROUPS",
    "CalibrationLog",
    "Change",
    "Check",
    "ColumnMap",
    "Excitation",
    "FitReport",
    "LogError",
    "Unknown",
    "Update",
    "calibrate_twin",
    "calibration_run",
    "check",
    "fit",
    "plot_prediction",
    "predict",
    "prepare",
    "read_bag",
    "read_csv",
    "read_excitation",
    "read_log",
    "record_twin",
    "update",
    "within_limits",
    "write_excitation",
]
