"""A calibration log from a recorded run: pressures and bend angles, by stamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from der_planner.bags.reader import BagError
from der_planner.bags.record import PRESSURE_TYPE, STATE_TYPE, BagRecord, LimbRecord, read_record
from der_planner.bags.run import Stream
from der_planner.bags.series import stream
from der_planner.identification.logs.log import CalibrationLog, LogError
from der_planner.model.series import CONTROL_PERIOD, interpolate

Array = NDArray[np.float64]

LONGEST_GAP = 0.25
"""Between two messages that a straight line may bridge [s]."""
LEAST = 10
"""Messages of each kind."""


def read_bag(path: str | Path, namespace: str = "") -> CalibrationLog:
    """Read the log of a run. The twin's ground truth is never looked at.

    Args:
        path: bag folder or file.
        namespace: of the limb, e.g. ``/limb``; needed only where a bag holds several.

    Raises:
        LogError: the bag cannot be read, holds several limbs and none is named, or lacks pressures
            or limb states; the message says which.
    """
    try:
        record = read_record(path)
    except BagError as error:
        raise LogError(str(error)) from error
    limb = _choose_limb(record, namespace)
    if len(limb.measured) < LEAST:
        raise LogError(
            f"the bag {path} holds no pressures ({PRESSURE_TYPE}): was the driver running?"
        )
    seen = np.isfinite(limb.tip.values(2)).all(axis=1)
    if seen.sum() < LEAST:
        raise LogError(
            f"the bag {path} holds no valid limb state ({STATE_TYPE}): was the limb seen?"
        )
    segment_count = limb.angles.width
    origin = int(limb.measured.stamps().min())
    commanded = stream(limb.commanded, segment_count, origin)
    measured = stream(limb.measured, segment_count, origin)
    angles = _seen(stream(limb.angles, segment_count, origin))
    start = max(measured.time[0], angles.time[0])
    end = min(measured.time[-1], angles.time[-1])
    if end - start < 1.0:
        raise LogError(f"in {path} pressures and limb states do not overlap: check the clocks")
    grid = np.arange(start, end, CONTROL_PERIOD)
    return CalibrationLog(
        time=grid - start,
        commanded_differential=_resampled(commanded, grid),
        measured_differential=_resampled(measured, grid),
        bend_angles=_resampled(angles, grid),
        tip=_resampled(_seen(stream(limb.tip, 2, origin)), grid),
        source=Path(path).name,
    )


def _choose_limb(record: BagRecord, namespace: str) -> LimbRecord:
    if namespace:
        if namespace not in record.limbs:
            known = ", ".join(sorted(record.limbs)) or "none"
            raise LogError(f"the bag {record.path} has no limb {namespace}, only {known}")
        return record.limbs[namespace]
    driven = [name for name, limb in record.limbs.items() if len(limb.measured)]
    if len(driven) > 1:
        raise LogError(
            f"the bag {record.path} holds several limbs, {', '.join(sorted(driven))}: name one "
            "with --namespace"
        )
    return record.limbs[driven[0]] if driven else LimbRecord()


def _seen(samples: Stream) -> Stream:
    """Return the samples without those at which the limb was not seen."""
    known = np.isfinite(samples.value).all(axis=1)
    return Stream(samples.time[known], samples.value[known])


def _resampled(samples: Stream, grid: Array) -> Array:
    """Return the samples on a grid, linear in between, NaN in gaps longer than `LONGEST_GAP`."""
    instants = samples.time
    result = interpolate(grid, instants, samples.value)
    after = np.clip(np.searchsorted(instants, grid), 1, len(instants) - 1)
    result[instants[after] - instants[after - 1] > LONGEST_GAP] = np.nan
    return result
