"""A plan played on a simulated limb in one process, with sensors, latency and feedback.

Simulated time is the only clock: the same plan, limb and seed give the same run, however busy the
machine is. Feedback is asked as on the graph: for each command some time before its instant, while
pictures arrive some ten milliseconds late.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from der_planner.arrays import Array
from der_planner.control.feedback import Feedback
from der_planner.model import CONTROL_PERIOD
from der_planner.planning.plan_file import Plan

_SMALLEST = 1e-5
"""Standard deviation that is told of a measurement without noise [rad], [m]."""


class Plant(Protocol):
    """A simulated limb with its air."""

    def advance(self, command: Array, duration: float) -> None:
        """Hold a command (M,) [Pa] for a time [s]."""

    @property
    def differential_pressure(self) -> Array:
        """(M,) in the chambers [Pa]."""

    @property
    def bend_angles(self) -> Array:
        """(M,) [rad]."""

    @property
    def tip(self) -> Array:
        """(2,) [m]."""


class Controller(Protocol):
    """What corrects a plan while it is played, as `Feedback` does; times count from its start."""

    def pressures(self, time: float, differential: Array) -> None:
        """Take in what the chambers hold (M,) [Pa]."""

    def measure(self, time: float, bend_angle: Array, tip: Array, covariance: Array) -> None:
        """Take in (M,) [rad] and (2,) [m] from a picture, late, with (M + 2, M + 2) of both."""

    def command(self, time: float) -> Array:
        """Return the command (M,) [Pa] from an instant on for 50 ms; asked for ahead, in order."""


@dataclass(frozen=True)
class Sensors:
    """What camera and board show, and when it is known.

    The noise is twice that of the tracker on rendered pictures (`docs/measurements/tracking.md`).

    Attributes:
        frame_rate: of the camera [Hz].
        latency: from a picture to its measurement [s].
        jitter: standard deviation of the latency, which is never below its half [s].
        lead: a command is asked for so long before its instant [s].
        bend_noise, tip_noise, pressure_noise: standard deviations [rad], [m], [Pa].
        seed: of noise and jitter.
        seen: tells if the limb is seen on a picture of an instant [s].
    """

    frame_rate: float = 30.0
    latency: float = 0.07
    jitter: float = 0.01
    lead: float = 0.15
    bend_noise: float = 5e-4
    tip_noise: float = 5e-5
    pressure_noise: float = 5.0
    seed: int = 0
    seen: Callable[[float], bool] = lambda _time: True


@dataclass(frozen=True)
class Played:
    """What happened, at the K instants of the commands.

    Attributes:
        time: (K,) [s].
        commanded: (K, M) [Pa].
        differential_pressure: (K, M) in the chambers [Pa].
        bend_angles: (K, M) true ones [rad].
        tip: (K, 2) true one [m].
        reference: (K, 2) r̄ [m].
        correction: (K, M) what feedback added to the plan's commands [Pa].
        estimated_tip: (K, 2) as `Feedback` estimated it at its own instant [m]; else NaN.
    """

    time: Array
    commanded: Array
    differential_pressure: Array
    bend_angles: Array
    tip: Array
    reference: Array
    correction: Array
    estimated_tip: Array

    @property
    def error(self) -> Array:
        """(K,) distance of the tip from r̄ [m]."""
        distance: Array = np.linalg.norm(self.tip - self.reference, axis=1)
        return distance


def play(
    plan: Plan,
    plant: Plant,
    feedback: Controller | None = None,
    sensors: Sensors | None = None,
    event: Callable[[float], None] = lambda _time: None,
) -> Played:
    """Play a plan from rest, with feedback or without.

    Args:
        plan: to play.
        plant: at rest.
        feedback: of the plan, or a controller of one's own.
        sensors: what it is told.
        event: called at every instant of a command or a picture, before the limb moves on.
    """
    sensors = sensors or Sensors()
    planned, segments = plan.differential_pressure, plan.limb.segment_count
    told = None if feedback is None else _Told(plant, feedback, sensors, segments)
    ahead = max(1, round(sensors.lead / CONTROL_PERIOD))

    def command(k: int) -> Array:
        if feedback is None:
            last: Array = planned[min(k, len(planned) - 1)]
            return last
        return feedback.command(k * CONTROL_PERIOD)

    commands, rows = [command(k) for k in range(ahead)], []
    for k in range(len(planned)):
        instant = k * CONTROL_PERIOD
        event(instant)
        if told is not None:
            told.inform(instant)
        commands.append(command(k + ahead))
        estimated = np.full(2, np.nan)
        if isinstance(feedback, Feedback):
            estimated = feedback.estimate(instant).tip
        # A plant may change its own arrays in place.
        state = map(np.array, (plant.differential_pressure, plant.bend_angles, plant.tip))
        rows.append((commands[k], *state, estimated))
        _advance(plant, commands[k], instant, sensors.frame_rate, event, told)
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    commanded, differential, bend, tip, estimated = columns
    return Played(
        plan.time,
        commanded,
        differential,
        bend,
        tip,
        plan.tip_reference,
        commanded - planned,
        estimated,
    )


def _advance(
    plant: Plant,
    command: Array,
    instant: float,
    frame_rate: float,
    event: Callable[[float], None],
    told: _Told | None,
) -> None:
    """Let a control period pass, with a picture at every instant of one."""
    now, end = instant, instant + CONTROL_PERIOD
    first, last = (math.ceil(time * frame_rate - 1e-6) for time in (instant, end))
    for taken in np.arange(first, last) / frame_rate:
        if taken > now:
            plant.advance(command, taken - now)
            now = taken
            event(now)
        if told is not None:
            told.film(taken)
    if end > now:
        plant.advance(command, end - now)


class _Told:
    """Tells feedback what camera and board show of a plant: with noise, and pictures late."""

    def __init__(self, plant: Plant, feedback: Controller, sensors: Sensors, segments: int) -> None:
        self._plant, self._feedback, self._sensors = plant, feedback, sensors
        self._draw = np.random.default_rng([47, sensors.seed])
        self._pictures: list[tuple[float, float, Array, Array]] = []
        deviation = np.repeat([sensors.bend_noise, sensors.tip_noise], [segments, 2])
        self._covariance = np.diag(np.maximum(deviation, _SMALLEST) ** 2)

    def inform(self, instant: float) -> None:
        """Tell the pressures of an instant [s], and the pictures that have arrived."""
        pressure = self._plant.differential_pressure
        noise = self._sensors.pressure_noise * self._draw.standard_normal(len(pressure))
        self._feedback.pressures(instant, pressure + noise)
        while self._pictures and self._pictures[0][0] <= instant:
            _, taken, bend, tip = heapq.heappop(self._pictures)
            self._feedback.measure(taken, bend, tip, self._covariance)

    def film(self, taken: float) -> None:
        """Take a picture at an instant [s]; it arrives later."""
        sensors, plant = self._sensors, self._plant
        if not sensors.seen(taken):
            return
        bend = plant.bend_angles
        bend = bend + sensors.bend_noise * self._draw.standard_normal(len(bend))
        tip = plant.tip + sensors.tip_noise * self._draw.standard_normal(2)
        delay = sensors.latency + sensors.jitter * float(self._draw.standard_normal())
        arrives = taken + max(delay, 0.5 * sensors.latency)
        heapq.heappush(self._pictures, (arrives, taken, bend, tip))
