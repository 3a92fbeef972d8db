"""The state estimator: a Kalman filter of what the limb does beside what the model expects.

Its state is the deviation from the model's motion under the plan
(`der_planner.estimation.nominal`):

    x = (δθ, δθ̇, d, g, b, log s)

bend angles [rad] and rates [rad/s], per segment the effective pressure d that the model lacks [Pa]
and the relative error g of its gain, a displacement b (2) of the tip that the bend angles do not
explain [m], and how many times stiffer s the limb is than its model, its gains as well. With w the
model's effective pressure under the *measured* chamber pressures and w̄ under the plan,

    M_w δθ̈ = s ((w − w̄) + d + g w − D_w δθ̇ − K_w δθ)

Where the limb rests, s changes nothing; how quickly it swings tells s. Corrections for a limb that
swings otherwise than expected would come in the wrong phase, and drive it. d, g and b wander.
Friction and creep remember the model's bend and the slow part of δθ: the noise of a measurement
must not wear off what friction remembers.

Measurements come late and in any order. The filter runs on a grid of `nominal.STEP` and keeps its
states of the last seconds; a measurement is put at its own instant, against the model at exactly
that instant, and what follows is computed again. A measurement that the filter did not expect
counts less (its covariance grows with its distance); where it happens again and again, something
has happened to the limb, and what is known of rates and disturbances becomes uncertain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from der_planner.arrays import Array
from der_planner.estimation.knowledge import Estimate, Knowledge
from der_planner.estimation.nominal import STEP, ChamberLog, Nominal
from der_planner.model import CONTROL_PERIOD, STEPS
from der_planner.model.material import Memory

HISTORY = 2.0
"""Measurements older than this, against the newest instant, come too late [s]."""
_WAITED_FOR = 1.0
"""The first picture that comes may be so much younger than one that comes later [s]."""
EARLIEST = 2.0
"""The limb is watched from so long before the first setpoint on [s]."""
_NOISE = (2e-3, 3e-4)
"""Deviation of a measured bend angle [rad] and tip [m] whose covariance is not given."""
_FIRST = (0.03, 0.03, 0.025, 0.15, 3e-3, 0.3)
"""Deviation of δθ [rad], δθ̇ [rad/s], d, g, b [m] and log s before the first measurement.

Pressures here are shares of the limb's pressure limit.
"""
_PRESSURE_DENSITY = 6.25e-4
"""Density of the effective pressure that is white noise [√s]."""
MISSING_DENSITY = 0.0104
"""Density with which d wanders [1/√s]."""
_GAIN_DENSITY = 0.01
"""Density with which g wanders [1/√s]."""
_TIP_DENSITY = 4e-4
"""Density with which b wanders [m/√s]."""
_TIP_TIME = 20.0
"""Time in which b is forgotten [s]."""
_MEMORY_TIME = 0.4
"""Time of the low-pass of δθ before friction and creep [s]."""
_STRANGE = 6.0
"""Squared distance per coordinate from where a measurement counts less."""
_STRANGEST = 200.0
"""Largest squared distance per coordinate with which one picture counts in their smoothed value."""
_EVENT = (0.0, 0.5, 0.042, 0.05, 0.0, 0.0)
"""What an event adds to the deviation of δθ, δθ̇ [rad/s], d, g, b and log s, as in `_FIRST`."""


@dataclass(frozen=True)
class _Measurement:
    time: float
    value: Array
    covariance: Array


class Estimator:
    """See the module.

    Args:
        nominal: the model's motion under the plan.
        chambers: their commands and readings.
        missing_density: with which d wanders, over the pressure limit [1/√s].
        history: states and measurements are kept for this long [s].

    Attributes:
        innovations: (time [s], squared normalised distance, coordinates) of every measurement
            when it first came.
        newest: stamp of the newest measurement [s].
    """

    def __init__(
        self,
        nominal: Nominal,
        chambers: ChamberLog,
        missing_density: float = MISSING_DENSITY,
        history: float = HISTORY,
    ) -> None:
        self.nominal, self.chambers = nominal, chambers
        self._kept = round(history / STEP)
        self.inputs = nominal.model.inputs
        self._limit = nominal.model.air.pneumatics.pressure_limit
        self.innovations: list[tuple[float, float, int]] = []
        self.newest = -math.inf
        self._measurements: dict[int, list[_Measurement]] = {}
        self._known: dict[int, Knowledge] = {}
        self._last = 0
        self._fresh: set[int] = set()
        self._log_stiffness = 0.0, _FIRST[-1] ** 2
        self._moves, self._noises = self._prepare(missing_density)

    # What comes in -------------------------------------------------------------------------

    def begin(self, time: float) -> None:
        """Start a second before an instant [s], if not started; older measurements are not used."""
        if not self._known:
            self._last = math.floor(max(time - _WAITED_FOR, -EARLIEST) / STEP)
            self._known[self._last] = self.beginning(self._last)

    def remember(self, other: Estimator) -> None:
        """Begin with the stiffness that an earlier run of this limb has told."""
        known = other.at(max(other.newest, 0.0))
        self._log_stiffness = known.mean[-1], known.covariance[-1, -1]

    def take_over(self, other: Estimator, time: float) -> None:
        """Begin at 0 s with what the estimator of another plan of this limb knows then.

        Args:
            other: of the plan that was played until now.
            time: its instant at which this plan begins [s].
        """
        known, told = other.at(time), other.estimate(time)
        inputs, mean = self.inputs, known.mean.copy()
        bend, rate, _ = self.nominal.at(0.0)
        mean[:inputs], mean[inputs : 2 * inputs] = told.bend_angle - bend, told.bend_rate - rate
        slow = known.slow + other.nominal.at(time)[0] - bend
        self._last = 0
        self._known = {0: replace(known, mean=mean, slow=slow)}
        self._measurements.clear()
        self.newest = other.newest - time

    def changed(self, time: float) -> None:
        """Compute again what depends on chamber pressures from an instant on [s]."""
        self._forget(math.floor(time / STEP))

    def measure(
        self, time: float, bend_angle: ArrayLike, tip: ArrayLike, covariance: ArrayLike | None
    ) -> None:
        """Take in a measurement at its own instant [s]; NaN: not seen. See `Feedback.measure`."""
        if np.shape(bend_angle) != (self.inputs,) or np.shape(tip) != (2,):
            raise ValueError(
                f"expected {self.inputs} bend angles and a tip (2,), got shapes "
                f"{np.shape(bend_angle)} and {np.shape(tip)}"
            )
        value = np.concatenate([bend_angle, tip]).astype(float)
        if not np.isfinite(value).any():
            return
        self.begin(time)
        j = round(time / STEP)
        if j < self._oldest:
            return
        entry = _Measurement(time, value, self._noise(covariance))
        self._measurements.setdefault(j, []).append(entry)
        self._fresh.add(id(entry))
        self.newest = max(self.newest, time)
        self._forget(j)

    def _noise(self, covariance: ArrayLike | None) -> Array:
        noise = np.diag(np.repeat(np.square(_NOISE), [self.inputs, 2]))
        given = noise if covariance is None else np.asarray(covariance, dtype=float)
        if given.shape not in ((2, 2), noise.shape) or not (
            np.isfinite(given).all() and np.linalg.eigvalsh(given)[0] >= -1e-9 * np.trace(given)
        ):
            raise ValueError(
                f"covariance must be that of the tip (2, 2) or of bend angles and tip "
                f"{noise.shape}, finite, with variances that are not negative, got {given.tolist()}"
            )
        noise[-len(given) :, -len(given) :] = given
        return noise

    # What goes out -------------------------------------------------------------------------

    def at(self, time: float) -> Knowledge:
        """Return the state at an instant [s]; after the newest measurement it is predicted."""
        self.begin(time)
        j = max(round(time / STEP), self._oldest)
        self._run(j)
        return self._updated(j, self._known[min(j, self._last)])

    def estimate(self, time: float) -> Estimate:
        """Return bend, rates, tip and what the model lacks at an instant [s]."""
        known = self.at(time)
        bend, rate, tip = self.nominal.at(time)
        change, speed, missing, gain, offset = known.parts
        deviation = np.sqrt(np.diag(known.covariance))
        rows = self.output(bend, change)[self.inputs :]
        return Estimate(
            time=time,
            bend_angle=bend + change,
            bend_rate=rate + speed,
            tip=tip + self.nominal.moved_tip(bend, change) + offset,
            missing_pressure=missing,
            gain_error=gain,
            tip_offset=offset,
            stiffness_ratio=known.stiffness_ratio,
            deviation=deviation[:-1],
            tip_covariance=rows @ known.covariance @ rows.T,
            age=time - self.newest,
        )

    def gap(self, known: Knowledge, k: int) -> Array:
        """Return the tip less r̄ (2,) [m] at control period ``k``."""
        nominal = self.nominal
        row = nominal.periods(k)
        moved = nominal.moved_tip(nominal.bend[row], known.mean[: self.inputs])
        gap: Array = nominal.tip[row] + moved + known.parts[-1] - nominal.reference[row]
        return gap

    def between(self, first: int, last: int) -> tuple[list[Knowledge], list[Knowledge]]:
        """Return the predicted and the corrected state at fine steps ``first`` … ``last``.

        Expected is without the measurements of the step itself; the steps must be in the history.
        """
        expected = [self._known[j] for j in range(first, last + 1)]
        known = [self._updated(j, k) for j, k in zip(range(first, last + 1), expected, strict=True)]
        return expected, known

    def move(self, j: int, known: Knowledge, felt: Array) -> tuple[Array, Array]:
        """Return F (4M + 3, 4M + 3) of a fine step, and the mean (4M + 3,) that it leads to.

        Args:
            j: the step.
            known: state before it.
            felt: (M,) effective pressure of the model in it [Pa].
        """
        nominal, inputs, swing = self.nominal, self.inputs, 2 * self.inputs
        k = int(nominal.periods(j // STEPS))
        push = known.stiffness_ratio * nominal.fine_input[k]
        move = self._moves[k].copy()
        move[:swing] *= known.stiffness_ratio
        move[:swing, swing + inputs : swing + 2 * inputs] = push * felt
        move[:swing, :swing] += nominal.free
        mean = move @ known.mean
        mean[:swing] += push @ (felt - nominal.effective[nominal.steps(j)])
        move[:swing, -1] = mean[:swing] - nominal.free @ known.mean[:swing]
        return move, mean

    # The filter ----------------------------------------------------------------------------

    @property
    def _oldest(self) -> int:
        """The first fine step that is kept; measurements before it come too late."""
        return next(iter(self._known))

    def beginning(self, first: int) -> Knowledge:
        """Return the prior state at fine step ``first``, before anything was measured."""
        inputs, deviation = self.inputs, self._deviations(_FIRST)
        zero = np.zeros(inputs)
        here = self.nominal.steps(first)
        memory = Memory(self.nominal.fine_bend[here], zero, zero)
        mean, covariance = np.zeros(4 * inputs + 3), np.diag(deviation**2)
        mean[-1], covariance[-1, -1] = self._log_stiffness
        return Knowledge(mean, covariance, zero, memory, zero, self.nominal.effective[here])

    def _deviations(self, parts: tuple[float, ...]) -> Array:
        """Return the deviations (4M + 3,) of the state from those of its parts, d in Pa."""
        units = [1.0, 1.0, self._limit, 1.0, 1.0, 1.0]
        return np.repeat(np.multiply(parts, units), [*[self.inputs] * 4, 2, 1])

    def _forget(self, j: int) -> None:
        """Compute again from boundary ``j`` on."""
        if self._known and j < self._last:
            j = max(j, self._oldest)
            for later in range(j + 1, self._last + 1):
                del self._known[later]
            self._last = j

    def _run(self, last: int) -> None:
        if last <= self._last:
            return
        steps = np.arange(self._last, last)
        differential = self.chambers.during(steps)
        # What friction and creep take changes once a control period.
        begins = np.flatnonzero((steps % STEPS == 0) | (steps == self._last))
        for first, held in zip(steps[begins], np.split(differential, begins[1:]), strict=True):
            self._period(int(first), held)
        self._last = last
        while self._oldest < last - self._kept:
            self._measurements.pop(self._oldest, None)
            del self._known[self._oldest]

    def _updated(self, j: int, known: Knowledge) -> Knowledge:
        for entry in self._measurements.get(j, ()):
            known = self._update(entry, known)
        return known

    def _period(self, first: int, differential: Array) -> None:
        """Go on from boundary ``first`` under a control period's chamber pressures (n, M) [Pa]."""
        nominal, inputs = self.nominal, self.inputs
        steps = nominal.steps(first + np.arange(len(differential)))
        k = int(nominal.periods(first // STEPS))
        known = self._known[first]
        memory, taken = known.memory, known.taken
        if first % STEPS == 0:
            memory, taken = self._remember(known, nominal.fine_bend[steps[0]] + known.slow)
        effective = nominal.model.material.without_memory(differential, taken)
        share = STEP / _MEMORY_TIME
        for i, felt in enumerate(effective):
            known = self._updated(first + i, self._known[first + i])
            move, mean = self.move(first + i, known, felt)
            self._known[first + i + 1] = Knowledge(
                mean,
                move @ known.covariance @ move.T + self._noises[k],
                known.slow + share * (known.mean[:inputs] - known.slow),
                memory,
                taken,
                felt,
                known.strange,
                known.row,
            )

    def _prepare(self, missing_density: float) -> tuple[Array, Array]:
        """Return F and the covariance that a fine step adds, of each control period.

        (K', 4M + 3, 4M + 3); F has no columns of g and log s, and of δθ and δθ̇ what forces change.
        """
        nominal, inputs = self.nominal, self.inputs
        size, swing = 4 * inputs + 3, 2 * inputs
        moves = np.tile(np.eye(size), (nominal.count, 1, 1))
        moves[:, :swing, :swing] = nominal.fine_transition - nominal.free
        moves[:, :swing, swing : swing + inputs] = nominal.fine_input
        moves[:, -3:-1, -3:-1] *= math.exp(-STEP / _TIP_TIME)
        wander = self._deviations((0.0, 0.0, missing_density, _GAIN_DENSITY, _TIP_DENSITY, 0.0))
        noises = np.tile(np.diag(wander**2 * STEP), (nominal.count, 1, 1))
        push = self._limit * _PRESSURE_DENSITY * nominal.fine_input
        noises[:, :swing, :swing] += push @ np.swapaxes(push, 1, 2) / STEP
        return moves, noises

    def _remember(self, known: Knowledge, bend: Array) -> tuple[Memory, Array]:
        """Return memory and taken pressures once the limb has come to a bend (M,) [rad]."""
        material = self.nominal.model.material
        if not material.has_memory:
            return known.memory, known.taken
        history = material.remember(
            np.array([0.0, CONTROL_PERIOD]), np.stack([known.memory.bend, bend]), known.memory
        )
        return history.at(-1), material.pressure_taken(history)[-1]

    def output(self, bend: Array, change: Array) -> Array:
        """Return ∂(bend angles, tip)/∂x (M + 2, 4M + 3) at a change (M,) of bend angles [rad]."""
        inputs = self.inputs
        rows = np.zeros((inputs + 2, 4 * inputs + 3))
        rows[:inputs, :inputs] = np.eye(inputs)
        rows[inputs:, :inputs] = self.nominal.kinematics.tip_jacobians(bend + change)
        rows[inputs:, -3:-1] = np.eye(2)
        return rows

    def _update(self, entry: _Measurement, known: Knowledge) -> Knowledge:
        inputs = self.inputs
        bend, _, tip = self.nominal.at(entry.time)
        change = known.mean[:inputs]
        moved = self.nominal.moved_tip(bend, change) + known.parts[-1]
        seen = np.isfinite(entry.value)
        gap = (entry.value - np.concatenate([bend + change, tip + moved]))[seen]
        rows = self.output(bend, change)[seen]
        noise = entry.covariance[np.ix_(seen, seen)]
        spread = known.covariance
        expected = rows @ spread @ rows.T + noise
        distance = float(gap @ np.linalg.solve(expected, gap)) / len(gap)
        if id(entry) in self._fresh:
            self._fresh.discard(id(entry))
            self.innovations.append((entry.time, distance * len(gap), len(gap)))
        row = known.row + 1 if distance > _STRANGE else 0
        if row >= 2:
            # Once may be a bad picture, twice is the limb: a push, a load, a gain that fell.
            spread = spread + np.diag(self._deviations(_EVENT) ** 2)
            expected = rows @ spread @ rows.T + noise
            row = 0
        elif row:
            expected = expected + noise * (distance / _STRANGE * len(gap))
        gain = np.linalg.solve(expected, rows @ spread).T
        mean = known.mean + gain @ gap
        spread = spread - gain @ expected @ gain.T
        spread = 0.5 * (spread + spread.T)
        smooth = known.strange + 0.05 * (min(distance, _STRANGEST) - known.strange)
        return replace(known, mean=mean, covariance=spread, strange=smooth, row=row)
