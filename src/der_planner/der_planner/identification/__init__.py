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
    FitReport,
    check,
    plot_prediction,
    predict,
)
from der_planner.identification.update import update

__all__ = [
    "GROUPS",
    "CalibrationLog",
    "ColumnMap",
    "Excitation",
    "FitReport",
    "LogError",
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
