"""What was measured and asked for in one run, as arrays: the input of every metric.

A bag becomes a `RunSeries` in `series`; runs without a bag (offline ones, logs of other tools)
build it from their arrays with `RunSeries.from_arrays`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from der_planner.arrays import Array, interpolate
from der_planner.methods import LEARNED


def method_name(method: str, learned_from: object = None) -> str:
    """Return a run's method; for a learned plan with the number of runs, where that is known."""
    name, _, rest = method.partition(" ")
    return f"{name} {learned_from} {rest}".strip() if name == LEARNED and learned_from else method


class EvaluationError(ValueError):
    """A run cannot be evaluated; the message names the run and what it lacks."""


@dataclass(frozen=True)
class Description:
    """What a run was.

    Attributes:
        motion, model, method: of the plan.
        trial, seed: of the experiment; -1 where unknown.
        amplitude: [rad], 0 for a path.
        period: of one cycle [s], 0 for a path.
        cycles: of the motion.
        limb: name of the limb file.
        bag: path of the bag, empty for a run without.
        namespace: of the limb's topics in the bag, e.g. ``/limb``; empty for a run without a bag.
        gravity: in `limb_base` that the plan reckons with [m/s²].
        payload: that it reckons with beside the limb's own masses [kg].
        payload_at: where, along the limb from its clamp [m]; 0 is the tip.
        extra: everything else that the recorder was told (versions, commit, machine …).
    """

    motion: str
    model: str
    method: str = ""
    trial: int = -1
    seed: int = -1
    amplitude: float = 0.0
    period: float = 0.0
    cycles: int = 0
    limb: str = ""
    bag: str = ""
    namespace: str = ""
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    payload: float = 0.0
    payload_at: float = 0.0
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """Return a name for messages."""
        return self.bag or f"{self.motion} {self.model} trial {self.trial}"


@dataclass(frozen=True)
class Stream:
    """A sampled quantity: time (N,) [s] since the first setpoint, value (N, …)."""

    time: Array
    value: Array

    def __len__(self) -> int:
        return len(self.time)

    def between(self, first: float, last: float) -> Stream:
        """Return the samples from one time [s] to another one."""
        inside = (self.time >= first) & (self.time <= last)
        return Stream(self.time[inside], self.value[inside])

    def at(self, instants: Array) -> Array:
        """Return the values at instants (I,) [s], on straight lines between the samples."""
        return interpolate(instants, self.time, self.value)

    @property
    def known(self) -> Stream:
        """The samples in which every number is finite."""
        finite = np.isfinite(self.value).all(axis=1)
        return Stream(self.time[finite], self.value[finite])


def _nothing(columns: int) -> Stream:
    return Stream(np.empty(0), np.empty((0, columns)))


class PressureArrays(NamedTuple):
    """Differential pressures of a run without a bag."""

    time: ArrayLike | None = None  # (P,) [s]
    commanded: ArrayLike | None = None  # (P, M) [Pa]
    measured: ArrayLike | None = None  # (P, M) [Pa]


@dataclass(frozen=True)
class BoardLog:
    """Setpoints as planned and commands as the board received them (twin only).

    Attributes:
        setpoint_time: (S,) instant at which each takes effect [s] since the first setpoint.
        setpoint: (S, M) differential pressure [Pa].
        command_time: (C,) arrival of the first byte of each command [s], same origin.
        command: (C, M) differential pressure that the command asks for [Pa].
    """

    setpoint_time: Array
    setpoint: Array
    command_time: Array
    command: Array


@dataclass(frozen=True)
class RunSeries:
    """One run. Time 0 is the instant of the first setpoint, by stamps.

    Attributes:
        description: what was run.
        reference: tip asked for (K, 2) [m] at the setpoints' times.
        predicted: tip that the model expects (K, 2) [m]; may be empty.
        tip: measured tip (F, 2) [m] at the images' stamps, NaN where the tracker found no limb.
        bend_angle: measured (F, M) [rad]; may be empty.
        tip_covariance: of the tip (F, 4), row by row [m²]; may be empty.
        setpoints: commands (K, M) as they were sent [Pa]; may be empty.
        commanded, measured: differential pressures (P, M) [Pa]; may be empty.
        truth: simulated tip (T, 2) [m]; only in bags of the twin.
        board: only in bags of the twin.
        faults: reasons that the driver gave during the motion.
        touches: what feedback said of what touched the limb, a sentence each.
        finished: the motion was played to its last setpoint.
        origin: ROS time of the first setpoint [ns]; 0 for a run without a bag.
        ahead: by which a stamp was later than the arrival of its message, at the most [s].
    """

    description: Description
    reference: Stream
    predicted: Stream
    tip: Stream
    bend_angle: Stream = field(default_factory=lambda: _nothing(0))
    tip_covariance: Stream = field(default_factory=lambda: _nothing(4))
    setpoints: Stream = field(default_factory=lambda: _nothing(0))
    commanded: Stream = field(default_factory=lambda: _nothing(0))
    measured: Stream = field(default_factory=lambda: _nothing(0))
    truth: Stream | None = None
    board: BoardLog | None = None
    faults: tuple[str, ...] = ()
    touches: tuple[str, ...] = ()
    finished: bool = True
    origin: int = 0
    ahead: float = 0.0

    @classmethod
    def from_arrays(
        cls,
        description: Description,
        *,
        time: ArrayLike,
        tip: ArrayLike,
        reference_time: ArrayLike,
        tip_reference: ArrayLike,
        tip_predicted: ArrayLike | None = None,
        pressures: PressureArrays | None = None,
        setpoints: ArrayLike | None = None,
    ) -> RunSeries:
        """Build a run from arrays.

        Args:
            description: what was run.
            time: (F,) of the measured tip [s], 0 at the first setpoint.
            tip: (F, 2) measured [m], NaN where unknown.
            reference_time: (K,) of the setpoints [s], rising from 0.
            tip_reference: (K, 2) [m].
            tip_predicted: (K, 2) [m].
            pressures: commanded and measured ones.
            setpoints: (K, M) commands of the plan [Pa].

        Raises:
            EvaluationError: shapes do not fit or times do not rise; the message says which.
        """
        held = pressures or PressureArrays()
        return cls(
            description=description,
            reference=as_stream(description, "tip_reference", reference_time, tip_reference, 2),
            predicted=as_stream(description, "tip_predicted", reference_time, tip_predicted, 2),
            tip=as_stream(description, "tip", time, tip, 2),
            commanded=as_stream(description, "commanded", held.time, held.commanded),
            measured=as_stream(description, "measured", held.time, held.measured),
            setpoints=as_stream(description, "setpoints", reference_time, setpoints),
        )


def as_stream(
    about: Description,
    name: str,
    time: ArrayLike | None,
    value: ArrayLike | None,
    columns: int = 0,
) -> Stream:
    """Return a stream of arrays that a caller gave, an empty one where it gave none.

    Args:
        about: the run.
        name: of the values in messages.
        time: (N,) [s].
        value: (N, M).
        columns: M; 0 for any number.

    Raises:
        EvaluationError: times do not rise, or shapes do not fit.
    """
    if time is None or value is None:
        return _nothing(columns)
    instants, rows = np.asarray(time, dtype=float), np.asarray(value, dtype=float)
    if instants.ndim != 1 or len(instants) < 2 or not np.all(np.diff(instants) > 0):
        raise EvaluationError(
            f"{about.title}: the times of {name} must be two or more rising ones, got shape "
            f"{instants.shape}"
        )
    if rows.ndim != 2 or len(rows) != len(instants) or columns not in (0, rows.shape[1]):
        wanted = f"({len(instants)}, {columns or 'M'})"
        raise EvaluationError(f"{about.title}: {name} must have shape {wanted}, got {rows.shape}")
    return Stream(instants, rows)
