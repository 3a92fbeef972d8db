"""What a recorded run shows of the limb afterwards: the estimator's run, smoothed backward.

The Kalman filter of `der_planner.estimation.estimator` goes over the whole run; the smoother of
Rauch, Tung and Striebel (1965) then brings to each instant what was seen after it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from der_planner.arrays import Array, interpolate
from der_planner.estimation.estimator import MISSING_DENSITY, Estimator
from der_planner.estimation.force import Touch
from der_planner.estimation.nominal import STEP, ChamberLog, Nominal
from der_planner.estimation.touch import TouchSense
from der_planner.limb import Limb
from der_planner.model import CONTROL_PERIOD, STEPS, RodModel, simulate
from der_planner.planning.motions import Reference
from der_planner.planning.plan_file import Plan
from der_planner.planning.timing import resting_spline

_SLOW = 0.0042
"""Density with which the pressure that the model lacks wanders in hindsight, over the limb's
pressure limit [1/√s].

It is less than feedback reckons with, so that a gain that is lower shows as a gain.
"""
_WHOLE = 1e6
"""A history that is longer than any run [s]."""
_BEFORE = 1.0
"""Pictures from so long before the first setpoint on are used [s]."""


@dataclass(frozen=True)
class Smoothed:
    """A run's motion as all of its pictures and pressures tell it, at K instants.

    Attributes:
        time: (K,) since the first setpoint [s], every 50 ms.
        bend_angle, bend_rate: (K, M) [rad], [rad/s].
        tip: (K, 2) [m].
        tip_covariance: (K, 2, 2) [m²].
        missing_pressure: (K, M) effective pressure that the model lacks, its gain error not
            counted [Pa].
        gain_error: (K, M) relative error of the model's effective pressure.
        deviation: (K, 4M + 2) standard deviations of bend angles, rates, missing pressure, gain
            error and the tip's offset, in this order.
        innovation: mean squared distance of the pictures from what the filter expected of them,
            per coordinate and by its own covariance; 1 if the covariance is right.
    """

    time: Array
    bend_angle: Array
    bend_rate: Array
    tip: Array
    tip_covariance: Array
    missing_pressure: Array
    gain_error: Array
    deviation: Array
    innovation: float

    def consistency(self, time: Array, tip: Array) -> float:
        """Return the mean squared distance from a true tip, per coordinate and by its covariance.

        1 if the covariance is right, less if it is too large.

        Args:
            time: (N,) rising instants [s].
            tip: (N, 2) where the tip truly was [m].
        """
        inside = (self.time >= time[0]) & (self.time <= time[-1])
        true = interpolate(self.time[inside], time, tip)
        gap = (self.tip[inside] - true)[..., None]
        squares = np.swapaxes(gap, 1, 2) @ np.linalg.solve(self.tip_covariance[inside], gap)
        return float(squares.mean() / 2)


@dataclass(frozen=True)
class Filmed:
    """What camera and board showed of a run; times since its first setpoint [s].

    Attributes:
        pressure_time: (P,).
        differential_pressure: (P, M) as measured in the chambers [Pa]; NaN where there was none.
        picture_time: (N,).
        bend_angle: (N, M) [rad]; NaN where a segment was not seen.
        tip: (N, 2) [m]; NaN where it was not seen.
    """

    pressure_time: Array
    differential_pressure: Array
    picture_time: Array
    bend_angle: Array
    tip: Array


def smooth(plan: Plan, filmed: Filmed) -> Smoothed:
    """Return what all of a recorded run says of the limb at each instant.

    Args:
        plan: what was played: limb, commands and reference.
        filmed: of the run.

    Raises:
        ValueError: no pictures or no measured pressures, or of another limb.
    """
    return _backward(*_forward(plan, filmed, _SLOW))


def touches(plan: Plan, filmed: Filmed) -> list[tuple[Touch, float]]:
    """Return what touched the limb in a recorded run, each when it was surest, and its end [s].

    Args:
        plan: what was played: limb, commands and reference.
        filmed: of the run.

    Raises:
        ValueError: no pictures or no measured pressures, or of another limb.
    """
    found = dict[float, tuple[Touch, float]]()
    for touch in _felt(plan, filmed)[1]:
        if touch.touched:
            best, _ = found.get(touch.since, (touch, 0.0))
            surest = max(best, touch, key=lambda each: each.distance)
            found[touch.since] = surest, touch.time
    return list(found.values())


def free_level(limb: Limb, time: Array, commands: Array, filmed: Filmed, unlike: float) -> str:
    """Return what a calibration run tells of the free level of its limb, for the limb file.

    Args:
        limb: as it was identified.
        time: (K,) every 50 ms from 0 on [s].
        commands: (K, M) then [Pa].
        filmed: of the run.
        unlike: least deviation of tips from where bends put them [m].

    Returns:
        See `FreeLevel.told`.

    Raises:
        ValueError: no pictures with a tip, or no measured pressures.
    """
    model, name = RodModel(limb), "calibration"
    response = simulate(model, time, commands=commands)
    tip, bend = response.tip[:-1], response.bend_angles[:-1]
    reference = Reference(time, tip, bend, resting_spline(time, bend), bend[0])
    plan = Plan(time, commands, reference, tip, bend, name, "der", name, 0.0, 0.0, 1, model, 0.0)
    free = _felt(plan, filmed)[0].free
    free.noise[-2:] = np.maximum(free.noise[-2:], unlike**2)
    return free.told()


def _felt(plan: Plan, filmed: Filmed) -> tuple[TouchSense, list[Touch]]:
    """Return the touch sense that has watched a whole run, and what it said every 50 ms."""
    estimator, last = _forward(plan, filmed, MISSING_DENSITY)
    nominal = estimator.nominal
    sense = TouchSense(nominal.model)
    states = estimator.between(0, last)[1][::STEPS]
    return sense, [sense.feel(k * CONTROL_PERIOD, nominal, known) for k, known in enumerate(states)]


def _forward(plan: Plan, filmed: Filmed, missing_density: float) -> tuple[Estimator, int]:
    """Return an estimator that has seen a whole run, and its last fine step."""
    nominal = Nominal(plan)
    chambers = ChamberLog(nominal, kept=_WHOLE)
    estimator = Estimator(nominal, chambers, missing_density, history=_WHOLE)
    for time, pressures in zip(filmed.pressure_time, filmed.differential_pressure, strict=True):
        chambers.read(float(time), pressures)
    seen = np.isfinite(filmed.tip).all(axis=1) & (filmed.picture_time > -_BEFORE)
    if not np.isfinite(chambers.newest) or not seen.any():
        raise ValueError("no measured chamber pressures, or no picture of the limb, in this run")
    pictures = filmed.picture_time[seen], filmed.bend_angle[seen], filmed.tip[seen]
    estimator.begin(min(0.0, float(pictures[0][0])))
    for time, bend, tip in zip(*pictures, strict=True):
        estimator.measure(float(time), bend, tip, None)
    last = round(min(float(pictures[0][-1]), float(plan.time[-1])) / STEP)
    estimator.at(last * STEP)
    return estimator, last


def _backward(estimator: Estimator, last: int) -> Smoothed:
    """Smooth from fine step ``last`` back to the first setpoint."""
    nominal = estimator.nominal
    expected, known = estimator.between(0, last)
    mean, spread = known[-1].mean, known[-1].covariance
    rows = []
    for j in range(last, -1, -1):
        if j < last:
            move, _ = estimator.move(j, known[j], expected[j + 1].effective)
            before = expected[j + 1]
            gain = np.linalg.solve(before.covariance, move @ known[j].covariance).T
            mean = known[j].mean + gain @ (mean - before.mean)
            spread = known[j].covariance + gain @ (spread - before.covariance) @ gain.T
        if j % STEPS == 0:
            rows.append((mean, spread))
    time = np.arange(len(rows), dtype=np.float64) * CONTROL_PERIOD
    means, spreads = (np.array(column[::-1]) for column in zip(*rows, strict=True))
    inputs = estimator.inputs
    change, speed, missing, gains, offset = np.split(
        means[:, :-1], np.arange(1, 5) * inputs, axis=1
    )
    bend, rate, tip = nominal.at(time)
    outputs = [estimator.output(b, c)[inputs:] for b, c in zip(bend, change, strict=True)]
    squares = [(square, count) for when, square, count in estimator.innovations if when >= 0]
    return Smoothed(
        time=time,
        bend_angle=bend + change,
        bend_rate=rate + speed,
        tip=tip + nominal.moved_tip(bend, change) + offset,
        tip_covariance=np.array([row @ p @ row.T for row, p in zip(outputs, spreads, strict=True)]),
        missing_pressure=missing,
        gain_error=gains,
        deviation=np.sqrt(np.diagonal(spreads, axis1=1, axis2=2))[:, :-1],
        innovation=sum(s for s, _ in squares) / max(1, sum(n for _, n in squares)),
    )
