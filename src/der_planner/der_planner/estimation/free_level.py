"""What the model lacks of a limb that nothing touches, by the estimator: the free level.

Gains, friction and the camera are a little wrong. What is lacking (`Lacking.value`) is then
c + γ·w + κ·θ + φ·z + e and some noise, with the pressures w of all segments, their bend angles θ
where gravity bends the limb as well, the share z of its friction that a segment has taken up, and
an e that wanders and is forgotten. c, γ, κ, φ, e and noise are learned while nothing is touched.
What a calibration told of γ, κ, φ and the noise stands in the limb file (`FreeLevel.told`).

A segment that sticks is held by anything between its largest friction one way and the other. Its
model says F z: what is lacking may be anything between F (z − 1) and F (z + 1) then, and nothing
beyond. A segment that has slid one way, and is stopped, may thus be held less than before, but no
harder: what holds it harder is a touch.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np

from der_planner.arrays import Array
from der_planner.estimation.knowledge import Knowledge
from der_planner.limb import Limb

_FREE_LEVEL = 0.0104, 2e-3
"""Standard deviations of c, of a limb that nothing is known of yet, as a share of its pressure
limit, and of the tip [m]."""
_FREE_NOISE = 0.0046, 2e-4
"""The same of e and noise together."""
_FREE_GAIN, _FREE_COUPLING, _FREE_TIP = 0.07, 0.03, 2.4e-3
"""The same of γ by a segment's own pressure and by that of another, and of the tip at the pressure
limit [m]."""
_FREE_STIFFNESS, _FREE_TIP_BENT = 0.08, 1e-3
"""The same of κ, over the segment's stiffness, and of the tip [m/rad]."""
_FREE_FRICTION = 0.15
"""The same of φ, over the largest friction that the model knows."""
_RUBS_UNEVENLY = 0.2
"""How far friction that is uneven along a segment moves the tip, over how far it bends the segment
times its length."""
_DAY = 1 / 3
"""Share of the first deviations of γ, κ and φ that comes back from one day to the next."""
_WANDERS = 0.5
"""Share of e in its variance and the noise's."""
_FORGOTTEN = 1.5
"""Time in which e is forgotten [s]."""
_FIRST_WORTH = 10.0
"""Time of watching that the guess of the noise is worth [s]."""
_WATCHED = 600.0
"""Time in which noise that was watched is forgotten [s]."""
_SAYS_NEW = 0.5
"""Time after which noise says something new of c, γ, κ and e [s]."""
_FRICTION_WRONG = 0.4
"""Standard deviation of friction from its model where it turns round, over its largest."""
_FRICTION_SLIDING = 0.0025
"""Its variance elsewhere, over the square of its largest."""
_STILL = 0.5
"""Share of the estimator's variance of what the model lacks that is left while nothing touches.

The estimator takes what is lacking for a random walk, which a gain K knows to K r, with r the noise
of pictures. Without a touch it hardly changes, and the same gain K knows it to K r / (2 − K), which
is half as much for a small K.
"""
_STICKS = 0.01
"""Rate of a bend angle below which its segment may stick [rad/s]."""
_SLIDES_AFTER, _LATEST_SLIDE = 2.0, 0.1
"""Way of a bend angle after which friction holds it as it should, once it has turned: over the
angle in which its model turns, and at the most [rad]."""


@dataclass(frozen=True)
class Lacking:
    """What the model lacks of the limb at an instant.

    Attributes:
        time: [s].
        bend_angles: (M,) [rad].
        effective: (M,) pressure w of the model [Pa].
        friction: (M,) z, −1 … 1.
        value: (M + 2,) pressure that the model lacks [Pa], and the tip's displacement that the
            bend angles do not explain [m].
        covariance: of value, where nothing changes and friction is what its model says.
        stuck: (2, M) least and most of value that friction explains of segments that stick [Pa].
    """

    time: float
    bend_angles: Array
    effective: Array
    friction: Array
    value: Array
    covariance: Array
    stuck: Array

    @staticmethod
    def of(
        time: float, limb: Limb, known: Knowledge, bend: Array, rate: Array, slid: Array
    ) -> Lacking:
        """Return what the estimator says that the model lacks.

        Args:
            time: [s].
            limb: of the model.
            known: the filter's state then.
            bend: (M,) bend angles of the limb [rad].
            rate: (M,) of them, without what swings [rad/s].
            slid: (M,) way that they have gone since they turned round, with its sign [rad].
        """
        inputs, turned = len(bend), known.memory.friction
        rows = np.zeros((inputs + 2, len(known.mean)))
        rows[:inputs, 2 * inputs : 3 * inputs] = np.eye(inputs)
        rows[:inputs, 3 * inputs : 4 * inputs] = np.diag(known.effective)
        rows[inputs:, 4 * inputs : -1] = np.eye(2)
        spread = _STILL * rows @ known.covariance @ rows.T
        # A bend that goes the other way than its friction says has turned, and friction with it.
        goes_on = np.maximum(slid * np.sign(turned), 0.0)
        slow = 1.0 / (1.0 + (rate / _STICKS) ** 2)
        turns = np.array([s.friction_curvature * s.length for s in limb.segments])
        after = np.clip(_SLIDES_AFTER * turns, 1e-6, _LATEST_SLIDE)
        sticks = np.maximum(slow, np.exp(-goes_on / after))
        sticks = np.minimum(1.0, sticks + 1.0 - turned**2)
        pressure, uneven = _friction(limb)
        spread[:inputs, :inputs] += _FRICTION_SLIDING * np.diag(pressure**2)
        spread[inputs:, inputs:] += (uneven**2 @ sticks) * np.eye(2)
        stuck = pressure * sticks * np.stack([turned - 1.0, turned + 1.0])
        return Lacking(time, bend, known.effective, turned, rows @ known.mean, spread, stuck)

    @property
    def doubtful(self) -> Array:
        """(M + 2, M + 2) covariance with that of friction where segments stick."""
        half = np.append(np.ptp(self.stuck, axis=0) / 2, np.zeros(2))
        return self.covariance + np.diag((_FRICTION_WRONG * half) ** 2)

    @property
    def beside_friction(self) -> Array:
        """(M + 2,) the least of value that friction does not explain where segments stick.

        A segment that has slid one way may be held less there, but no harder.
        """
        left, segments = self.value.copy(), self.stuck.shape[1]
        left[:segments] -= np.clip(left[:segments], *self.stuck)
        return left

    def regressors(self, kept: float) -> Array:
        """Return what c, γ, κ, φ and e are multiplied by, with the share of e that is left."""
        return np.concatenate([[1.0], self.effective, self.bend_angles, self.friction, [kept]])


def _friction(limb: Limb) -> tuple[Array, Array]:
    """Return the largest friction of the segments (M,) [Pa], and how far it moves the tip [m]."""
    pressure = np.array([s.friction_moment / s.moment_gain for s in limb.segments])
    lengths = np.array([s.length for s in limb.segments])
    return pressure, _RUBS_UNEVENLY * pressure * limb.static_gain * lengths


class FreeLevel:
    """What the model lacks of a limb that nothing touches: c + γ·w + κ·θ + φ·z + e, and noise.

    Args:
        limb: of M segments.

    Attributes:
        noise: (M + 2,) variance of e and noise together.
        payload: at the tip, beside what was planned [kg].
    """

    def __init__(self, limb: Limb) -> None:
        self.payload = 0.0
        inputs, limit = limb.segment_count, limb.pneumatics.pressure_limit
        self._level, noise = (
            np.repeat([limit * pressure, tip], [inputs, 2])
            for pressure, tip in (_FREE_LEVEL, _FREE_NOISE)
        )
        slope = np.full((inputs + 2, inputs), _FREE_TIP / limit)
        slope[:inputs] = _FREE_COUPLING + (_FREE_GAIN - _FREE_COUPLING) * np.eye(inputs)
        bent = np.zeros_like(slope)
        if limb.weighs_in_plane:
            stiffness = [s.bending_stiffness / s.length / s.moment_gain for s in limb.segments]
            bent[:inputs], bent[inputs:] = _FREE_STIFFNESS * np.diag(stiffness), _FREE_TIP_BENT
        friction, uneven = _friction(limb)
        rubs = np.vstack([_FREE_FRICTION * np.diag(friction), uneven, uneven])
        known = np.column_stack([self._level, slope, bent, rubs, np.zeros(inputs + 2)])
        self._mean = np.zeros_like(known)
        told, slopes = np.array(limb.calibrated.free_level.split(), dtype=float), known[:, 1:-1]
        if len(told) == 2 * slopes.size + len(noise) and not limb.other_mounting:
            mean, deviation, noise = np.split(told, [slopes.size, 2 * slopes.size])
            self._mean[:, 1:-1] = mean.reshape(slopes.shape)
            known[:, 1:-1] = np.hypot(deviation.reshape(slopes.shape), _DAY * slopes)
        self._covariance = known[:, :, None] ** 2 * np.eye(known.shape[1])
        self.noise = noise**2
        self._covariance[:, -1, -1] = _WANDERS * self.noise
        self._worth = _FIRST_WORTH

    def for_next_run(self) -> FreeLevel:
        """Return what is known of the limb in its next run: it may rest and be loaded otherwise."""
        after = copy.deepcopy(self)
        after.payload = 0.0
        after._covariance[:, 0, 0] += self._level**2
        return after

    def told(self) -> str:
        """Return means and deviations of γ, κ and φ, and the noise, as a limb file keeps them."""
        deviation = np.sqrt(np.diagonal(self._covariance, axis1=1, axis2=2))
        kept = self._mean[:, 1:-1], deviation[:, 1:-1], np.sqrt(self.noise)
        return " ".join(f"{value:.4g}" for each in kept for value in each.flat)

    def expected(self, lacking: Lacking, ahead: float = 0.0) -> tuple[Array, Array]:
        """Return mean and variance (M + 2,), noise and all.

        Args:
            lacking: tells pressures and bend angles.
            ahead: time since something was learned [s].
        """
        kept = np.exp(-ahead / _FORGOTTEN)
        by = lacking.regressors(kept)
        left = _WANDERS * (1.0 - kept**2) + 1.0 - _WANDERS
        return self._mean @ by, by @ self._covariance @ by + left * self.noise

    def learn(self, lacking: Lacking, duration: float, away: Array, variance: Array) -> None:
        """Take in what held without contact.

        Args:
            lacking: then.
            duration: for which it held [s].
            away: (M + 2,) from what was expected before, beside what friction explains.
            variance: (M + 2,) that was expected, see `expected`.
        """
        kept = np.exp(-duration / _FORGOTTEN)
        self._mean[:, -1] *= kept
        self._covariance[:, -1] *= kept
        self._covariance[:, :, -1] *= kept
        self._covariance[:, -1, -1] += _WANDERS * (1.0 - kept**2) * self.noise
        by = lacking.regressors(1.0)
        other = np.diag(lacking.doubtful)
        seen = self._covariance @ by
        white = (1.0 - _WANDERS) * self.noise
        old = _SAYS_NEW / duration * (white + other)
        gain = seen / (seen @ by + old)[:, None]
        left = replace(lacking, value=lacking.value - self._mean @ by).beside_friction
        self._mean += gain * left[:, None]
        self._covariance -= gain[:, :, None] * seen[:, None, :]
        # How much of what was away is noise and e, by what was expected of each.
        total = variance + np.diag(lacking.covariance)
        part = np.minimum(1.0, self.noise / total)
        found = self.noise * (1.0 + part * (away**2 / total - 1.0))
        self.noise = self.noise + duration / (self._worth + duration) * (found - self.noise)
        self._worth = min(self._worth + duration, _WATCHED)
