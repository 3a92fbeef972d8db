"""From logs to a limb file: excitation, fits, reports, and checks of later runs."""

from der_planner.identification.check import Check, check
from der_planner.identification.excitation import (
    Excitation,
    calibration_run,
    read_excitation,
    within_limits,
    write_excitation,
)
from der_planner.identification.fit import fit
from der_planner.identification.logs.bag import read_bag
from der_planner.identification.logs.log import CalibrationLog, LogError
from der_planner.identification.logs.table import ColumnMap, read_csv
from der_planner.identification.offline import calibrate_twin, record_twin
from der_planner.identification.predict import Prediction, predict
from der_planner.identification.report import Change, FitReport, Unknown, Update
from der_planner.identification.update import update

__all__ = [
    "CalibrationLog",
    "Change",
    "Check",
    "ColumnMap",
    "Excitation",
    "FitReport",
    "LogError",
    "Prediction",
    "Unknown",
    "Update",
    "calibrate_twin",
    "calibration_run",
    "check",
    "fit",
    "predict",
    "read_bag",
    "read_csv",
    "read_excitation",
    "record_twin",
    "update",
    "within_limits",
    "write_excitation",
]
