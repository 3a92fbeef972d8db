"""How far feedback trusts what it knows: errors of its predictions, as far ahead as it acts.

A correction that is sent now bends the limb half a second after the newest picture. What was known
so long ago is rolled forward under the pressures that the chambers truly had, and compared with the
bend that was seen then. The predicted deviation of the bend has four parts that add up:

    δθ = (what the corrections do) + swing + slow + fast

swing: what the deviation of bend and rate was beyond that at rest under the present pressures, and
how it goes on. Slow: the effect of the missing pressure's slow part, with the gain's error. Fast:
that of the rest of the missing pressure. Of each segment the weights 0 … 1 of the last three that
fit the last seconds best, by least squares with a pull toward 1, are the trust. Where the swing is
not predicted, since stiffness or friction are others than the model's, its weight falls, and
feedback acts on what is slow; where neither is, it leaves the limb to the plan.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from der_planner.arrays import Array
from der_planner.control.estimation import Estimator
from der_planner.control.knowledge import Knowledge
from der_planner.control.nominal import Nominal
from der_planner.model import CONTROL_PERIOD, STEPS

AHEAD = 10
"""Control periods from the newest picture to what a correction based on it does: the way of the
picture, the lead of a command, dead time and lag of the chambers."""
_SLOW = 2.0
"""Time over which the missing pressure is averaged to tell its slow part [s]."""
_FIRST = 0.3
"""The same when the limb has just been seen [s]."""
_REMEMBERED = 6.0
"""Time in which an error of the prediction is forgotten [s]."""
_PULL = 30.0
"""The pull toward 1 is worth so many predictions that were wrong by as much as the usual one."""
_SMALLEST_ERROR = 1e-3
"""Error of a prediction that is too small to tell anything [rad]."""
_SWEEPS = 4
"""Of the search for the weights within 0 … 1, which begins at the last ones."""


class Trust:
    """The weights of the parts of a prediction.

    Args:
        inputs: M segments.

    Attributes:
        weights: (3, M) of swing, slow and fast, 0 … 1.
    """

    def __init__(self, inputs: int) -> None:
        self.weights = np.ones((3, inputs))
        self._square = np.zeros((3, 3, inputs))
        self._product = np.zeros((3, inputs))
        self._error = np.zeros(inputs)
        self._count = 0.0

    def learn(self, parts: Array, seen: Array) -> None:
        """Compare a prediction with what was seen.

        Args:
            parts: (3, M) swing, slow and fast [rad].
            seen: (M,) what they should add up to [rad].
        """
        keep = np.exp(-CONTROL_PERIOD / _REMEMBERED)
        self._count = keep * self._count + 1.0
        self._square = keep * self._square + parts[:, None] * parts[None]
        self._product = keep * self._product + parts * seen
        self._error = keep * self._error + (seen - (self.weights * parts).sum(axis=0)) ** 2
        pull = _PULL * np.maximum(self._error / self._count, _SMALLEST_ERROR**2)
        for _ in range(_SWEEPS):
            for i, own in enumerate(self._square):
                others = (own * self.weights).sum(axis=0) - own[i] * self.weights[i]
                best = (self._product[i] + pull - others) / (own[i] + pull)
                self.weights[i] = np.clip(best, 0.0, 1.0)


class Foresight:
    """Weighs what the estimator knows by how well it predicted; see the module.

    Args:
        nominal: the model's motion under the plan.
        estimator: of the limb along it.
    """

    def __init__(self, nominal: Nominal, estimator: Estimator) -> None:
        self._nominal, self._estimator = nominal, estimator
        self.trust = Trust(nominal.model.inputs)
        self._slow = np.zeros(nominal.model.inputs)
        self._slow_at: dict[int, Array] = {}
        self._watched = 0.0
        self._newest: int | None = None

    def take_over(self, other: Foresight) -> None:
        """Go on with what the feedback of another plan of this limb has learned."""
        self.trust, self._slow, self._watched = other.trust, other._slow, other._watched

    def learn(self) -> None:
        """Look at the prediction of the newest picture's instant, once a control period."""
        if not np.isfinite(self._estimator.newest):
            return
        newest = int(np.floor(self._estimator.newest / CONTROL_PERIOD))
        now = self._estimator.kept(newest * STEPS, newest * STEPS)
        if now is None or (self._newest is not None and newest <= self._newest):
            return
        passed = 1 if self._newest is None else newest - self._newest
        self._newest = newest
        self._watched += passed * CONTROL_PERIOD
        share = passed * CONTROL_PERIOD / min(_SLOW, _FIRST + self._watched)
        self._slow = self._slow + min(share, 1.0) * (now[0].parts[2] - self._slow)
        self._slow_at = {k: d for k, d in self._slow_at.items() if k >= newest - AHEAD}
        self._slow_at[newest] = self._slow
        first = newest - AHEAD
        states = self._estimator.kept(first * STEPS, newest * STEPS)
        if states is None or first not in self._slow_at:
            return
        done, *parts = self._predicted(first, states)
        seen = states[-1].mean[: len(done)]
        self.trust.learn(np.array(parts), seen - done)

    def weighed(self, known: Knowledge, k: int) -> Knowledge:
        """Return what is known at the beginning of control period ``k``, as far as it is trusted.

        Args:
            known: as the estimator says.
            k: period.
        """
        swing_trust, slow_trust, fast_trust = self.trust.weights
        _, _, missing, gain, offset = known.parts
        slow = slow_trust * self._slow
        fast = fast_trust * (missing - self._slow)
        done = known.effective - self._nominal.effective[self._nominal.steps(k * STEPS)]
        still = self._still(k)
        swing = known.mean[: still.shape[0]] - still @ (done + missing + gain * known.effective)
        trusted = slow_trust * gain
        swing = swing * np.tile(swing_trust, 2)
        swing = swing + still @ (done + slow + fast + trusted * known.effective)
        return replace(known, mean=np.concatenate([swing, slow + fast, trusted, offset]))

    def _still(self, k: int) -> Array:
        """Return ∂(δθ, δθ̇)/∂w (2M, M) of a limb that has come to rest, about control period k."""
        row = self._nominal.periods(k)
        move = self._nominal.transition[row]
        still = np.linalg.solve(np.eye(len(move)) - move, self._nominal.input[row])
        return np.asarray(still, dtype=np.float64)

    def _predicted(self, first: int, states: Sequence[Knowledge]) -> Array:
        """Return the parts (4, M) of δθ [rad] that were predicted for the last of some states.

        They are what the corrections do, swing, slow and fast.

        Args:
            first: control period at whose beginning the first state is.
            states: at the boundaries of all fine steps from there on.
        """
        nominal, inputs = self._nominal, self._nominal.model.inputs
        periods = (len(states) - 1) // STEPS
        _, _, missing, gain, _ = states[0].parts
        slow = self._slow_at[first]

        def pushed(felt: Array, planned: Array) -> Array:
            """Return what pushes bend, but for the swing, (M, 3) [Pa]."""
            return np.stack([felt - planned, slow + gain * felt, missing - slow], axis=1)

        fine = nominal.steps(first * STEPS + np.arange(periods * STEPS))
        planned = nominal.effective[fine].reshape(periods, STEPS, inputs).mean(axis=1)
        felt = np.array([state.effective for state in states[1:]])
        felt = felt.reshape(periods, STEPS, inputs).mean(axis=1)
        rest = self._still(first) @ pushed(states[0].effective, nominal.effective[fine[0]])
        swing = states[0].mean[: 2 * inputs] - rest.sum(axis=1)
        parts = np.concatenate([rest, swing[:, None]], axis=1)
        for i, row in enumerate(nominal.periods(first + np.arange(periods))):
            parts = nominal.transition[row] @ parts
            parts[:, :3] += nominal.input[row] @ pushed(felt[i], planned[i])
        return parts[:inputs, [0, 3, 1, 2]].T
