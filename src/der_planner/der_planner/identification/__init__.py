"""From logs to a limb file."""

from der_planner.identification.log import CalibrationLog, LogError
from der_planner.identification.offline import CalibrationReport, calibrate_twin

__all__ = ["CalibrationLog", "CalibrationReport", "LogError", "calibrate_twin"]
