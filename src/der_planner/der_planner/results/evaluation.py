"""The error of one run, as the paper's Table I reads it, and where it comes from.

With r̄ the tip reference of the plan, interpolated linearly at the stamp of each image (the plan's
setpoints are 50 ms apart, which costs under 0.01 mm at 20 s a cycle), r the measured tip, and the
window from the first to the last setpoint of the plan: E is the mean over the valid images of
|r − r̄|, its components the means of |x − x̄| and |y − ȳ|.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from der_planner.arrays import Array, rms_distance
from der_planner.bags.reader import BagError
from der_planner.bags.record import read_record
from der_planner.bags.run import EvaluationError, RunSeries
from der_planner.bags.series import run_of
from der_planner.limb import mounting_of
from der_planner.results.errors import (
    Split,
    check_board,
    check_tracker,
    error_series,
    split_error,
    window,
)

GAP = 0.5
"""Longest time without a valid image [s] that leaves a run fit for comparison."""
LEAST_VALID = 0.9
"""Least share of valid images of such a run."""
DRAWN = "drawn_path_m"
"""Key of the drawn points, of a run along the nearest path to them."""
NEAREST = ", nearest path"
"""Ends the name of such a run's motion."""
REFERENCE_POINTS = 25
OTHER_COMMAND = 0.1
"""Commands that differ from the setpoints by this share of the largest setpoint are others."""
LARGEST_AHEAD = 1e-3
"""Stamps may be this far [s] from the future in such a run."""


@dataclass(frozen=True)
class RunResult(Split):
    """The figures of one run; field names carry their units, as in ``results.json``.

    ``valid_fraction`` is the share of the images in the window whose limb state is valid;
    ``dropped_frames`` is estimated from the gaps between stamps. ``problems`` says in words what
    makes the run unfit for a comparison; ``reference_points_m`` is r̄ at 25 evenly spaced instants
    of the window. ``checks`` holds figures of the instruments (`errors`).
    """

    motion: str
    model: str
    method: str
    trial: int
    seed: int
    mean_error_m: float
    mean_error_x_m: float
    mean_error_y_m: float
    max_error_m: float
    valid_fraction: float
    bag: str
    rms_error_m: float = float("nan")
    predicted_error_m: float = float("nan")
    frames: int = 0
    dropped_frames: int = 0
    longest_gap_s: float = float("nan")
    window_s: tuple[float, float] = (0.0, 0.0)
    amplitude_rad: float = 0.0
    period_s: float = 0.0
    cycles: int = 0
    limb: str = ""
    namespace: str = ""
    mounting: str = "horizontal"
    gravity_m_s2: tuple[float, float, float] = (0.0, 0.0, 0.0)
    payload_kg: float = 0.0
    payload_at_m: float = 0.0
    pressure_rms_error_pa: tuple[float, ...] = ()
    problems: tuple[str, ...] = ()
    reference_points_m: tuple[tuple[float, float], ...] = ()
    checks: Mapping[str, float] = field(default_factory=dict)
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def loads(self) -> str:
        """Mounting and payload in words; empty for a horizontal limb without payload."""
        if not self.payload_kg:
            return "" if self.mounting == "horizontal" else self.mounting
        place = f" at {self.payload_at_m * 100:.1f} cm" if self.payload_at_m else ""
        return f"{self.mounting}, {self.payload_kg * 1000:.4g} g{place}"


def json_value(value: Any) -> Any:
    """Return a value as JSON can say it: tuples as lists, NaN and infinity as None."""
    if isinstance(value, dict):
        return {key: json_value(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def evaluate_run(run: RunSeries) -> RunResult:
    """Compute every figure of a run.

    Args:
        run: from `load_run` or `RunSeries.from_arrays`.

    Raises:
        EvaluationError: there is no valid image in the window.
    """
    series = error_series(run)
    distance = np.linalg.norm(series.value, axis=1)
    first, last = window(run)
    images = run.tip.between(first, last).time
    dropped, longest = _gaps(images, series.time, first, last)
    split = split_error(run)
    about = run.description
    valid = len(series.time) / max(1, len(images))
    return RunResult(
        motion=about.motion + (NEAREST if DRAWN in about.extra else ""),
        model=about.model,
        method=about.method,
        trial=about.trial,
        seed=about.seed,
        mean_error_m=float(distance.mean()),
        mean_error_x_m=float(np.abs(series.value[:, 0]).mean()),
        mean_error_y_m=float(np.abs(series.value[:, 1]).mean()),
        max_error_m=float(distance.max()),
        valid_fraction=min(1.0, valid),
        bag=about.bag,
        rms_error_m=rms_distance(series.value),
        predicted_error_m=_predicted_error(run),
        frames=len(images),
        dropped_frames=dropped,
        longest_gap_s=longest,
        window_s=(first, last),
        amplitude_rad=about.amplitude,
        period_s=about.period,
        cycles=about.cycles,
        limb=about.limb,
        namespace=about.namespace,
        mounting=mounting_of(about.gravity),
        gravity_m_s2=about.gravity,
        payload_kg=about.payload,
        payload_at_m=about.payload_at,
        **dataclasses.asdict(split),
        pressure_rms_error_pa=_pressure_errors(run, first, last),
        problems=_problems(run, valid, longest),
        reference_points_m=_reference_points(run, first, last),
        checks=check_tracker(run.tip, run.truth, first, last) | check_board(run.board),
        extra=dict(about.extra),
    )


def _gaps(stamps: Array, valid: Array, first: float, last: float) -> tuple[int, float]:
    """Return the images missing between stamps, and the longest time without a valid one [s]."""
    steps = np.diff(stamps)
    dropped = 0
    if len(steps):
        dropped = int(np.sum(np.maximum(0, np.rint(steps / np.median(steps)) - 1)))
    return dropped, float(np.diff(np.concatenate([[first], valid, [last]])).max())


def _reference_points(run: RunSeries, first: float, last: float) -> tuple[tuple[float, float], ...]:
    """Return r̄ at evenly spaced instants of the window: enough to tell two references apart."""
    points = run.reference.at(np.linspace(first, last, REFERENCE_POINTS))
    return tuple((round(float(x), 6), round(float(y), 6)) for x, y in points)


def _predicted_error(run: RunSeries) -> float:
    if not len(run.predicted):
        return float("nan")
    return float(np.linalg.norm(run.predicted.value - run.reference.value, axis=1).mean())


def _pressure_errors(run: RunSeries, first: float, last: float) -> tuple[float, ...]:
    """RMS of measured minus commanded differential pressure, one a segment [Pa]."""
    if not len(run.measured) or not len(run.commanded):
        return ()
    measured, commanded = run.measured.between(first, last), run.commanded.between(first, last)
    difference = measured.value - commanded.value
    if not np.isfinite(difference).any(axis=0).all():
        return ()
    return tuple(np.sqrt(np.nanmean(difference**2, axis=0)).tolist())


def _other_commands(run: RunSeries) -> float:
    """Return the share of the driver's ticks at which it did not command the plan's setpoint."""
    if not len(run.setpoints) or not len(run.commanded):
        return 0.0
    ticks = run.commanded.between(*run.setpoints.time[[0, -1]])
    apart = np.abs(ticks.value - run.setpoints.at(ticks.time)).max(axis=1)
    others = apart > OTHER_COMMAND * np.abs(run.setpoints.value).max()
    return float(others.sum()) / max(1, len(ticks))


def _problems(run: RunSeries, valid: float, longest: float) -> tuple[str, ...]:
    found = [f"the driver reported a fault: {text}" for text in run.faults]
    found += [f"something touched the limb {text}" for text in run.touches]
    if not run.finished:
        found.append(
            "setpoints or limb states end before the motion: was it stopped, or the tracker?"
        )
    if valid < LEAST_VALID:
        found.append(f"only {valid:.0%} of the images have a valid limb state")
    if longest > GAP:
        found.append(f"{longest:.1f} s without a valid limb state")
    if (others := _other_commands(run)) > 1.0 - LEAST_VALID:
        found.append(
            f"for {others:.0%} of the time the driver commanded other pressures: see its log"
        )
    if run.ahead > LARGEST_AHEAD:
        found.append(f"stamps come from up to {1e3 * run.ahead:.0f} ms in the future: see `clocks`")
    return tuple(found)


@dataclass(frozen=True)
class Evaluated:
    """One limb of one bag: its run and result, or the reason why there is none."""

    path: Path
    run: RunSeries | None = None
    result: RunResult | None = None
    error: str = ""


def evaluate_bags(paths: Sequence[Path]) -> Iterator[Evaluated]:
    """Evaluate bags one after the other; one that fails does not stop the others.

    Args:
        paths: bag folders or files.

    Yields:
        One entry per limb that has a plan, in the order of the paths; one with the reason for a
        bag without any.
    """
    for path in paths:
        try:
            record = read_record(path)
        except (BagError, OSError) as error:
            yield Evaluated(path, error=str(error))
            continue
        for namespace in sorted(record.played or record.limbs) or [""]:
            try:
                run = run_of(record, namespace)
                yield Evaluated(path, run, evaluate_run(run))
            except (BagError, EvaluationError, OSError) as error:
                yield Evaluated(path, error=str(error))
