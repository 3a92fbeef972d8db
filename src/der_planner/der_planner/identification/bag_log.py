"""A calibration log from a recorded run: pressures and bend angles, by stamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from der_planner.identification.log import CalibrationLog, LogError
from der_planner.runs.recording.reader import BagError, BagReader

Array = NDArray[np.float64]

PRESSURE_TYPE = "der_msgs/msg/PressureState"
STATE_TYPE = "der_msgs/msg/LimbState"
TRUTH = "ground_truth"
PERIOD = 0.05
LONGEST_GAP = 0.25
"""Between two messages that a straight line may bridge [s]."""


def read_bag(path: str | Path) -> CalibrationLog:
    """Read the log of a run. The twin's ground truth is never looked at.

    Raises:
        LogError: the bag cannot be read, or lacks pressures or limb states; the message says which.
    """
    pressures: list[tuple[float, list[float], list[float]]] = []
    states: list[tuple[float, list[float], list[float]]] = []
    try:
        with BagReader(path) as bag:
            wanted = [
                name
                for name, topic in bag.topics.items()
                if topic.type_name in (PRESSURE_TYPE, STATE_TYPE) and not name.endswith(TRUTH)
            ]
            for name, _, message in bag.messages(wanted):
                stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
                if bag.topics[name].type_name == PRESSURE_TYPE:
                    pressures.append(
                        (
                            stamp,
                            list(message.commanded_differential),
                            list(message.measured_differential),
                        )
                    )
                elif message.valid:
                    states.append((stamp, list(message.bend_angle), [message.tip.x, message.tip.y]))
    except BagError as error:
        raise LogError(str(error)) from error
    if len(pressures) < 10:
        raise LogError(
            f"the bag {path} holds no pressures ({PRESSURE_TYPE}): was the driver running?"
        )
    if len(states) < 10:
        raise LogError(
            f"the bag {path} holds no valid limb state ({STATE_TYPE}): was the limb seen?"
        )
    return _merge(pressures, states, str(path))


def _merge(
    pressures: list[tuple[float, list[float], list[float]]],
    states: list[tuple[float, list[float], list[float]]],
    source: str,
) -> CalibrationLog:
    start = max(pressures[0][0], states[0][0])
    end = min(pressures[-1][0], states[-1][0])
    if end - start < 1.0:
        raise LogError(f"in {source} pressures and limb states do not overlap: check the clocks")
    grid = np.arange(start, end, PERIOD)

    def column(rows: list[tuple[float, list[float], list[float]]], place: int) -> Array:
        instants = np.array([row[0] for row in rows])
        values = np.array([row[place] for row in rows], dtype=float)
        order = np.argsort(instants, kind="stable")
        instants, values = instants[order], values[order]
        result = np.stack([np.interp(grid, instants, part) for part in values.T], axis=1)
        after = np.clip(np.searchsorted(instants, grid), 1, len(instants) - 1)
        result[instants[after] - instants[after - 1] > LONGEST_GAP] = np.nan
        return result

    return CalibrationLog(
        time=grid - start,
        commanded_differential=column(pressures, 1),
        measured_differential=column(pressures, 2),
        bend_angles=column(states, 1),
        tip=column(states, 2),
        source=Path(source).name,
    )
