"""How much of feedback's corrections is worth sending: what was predicted, and what it brought.

What the horizon wants is taken apart into what is slow, a low-pass of it, and the rest, which damps
or drives swing. Each is sent as far as it has proved right, on this limb in this run:

- The rest counts as far as swing is predicted. The tip was predicted for the instant of each
  command, from the newest picture then; with p what a picture of that instant showed beyond it, and
  q beyond the newest picture's tip, as if the deviation stayed as it is,

      β = 1 − (Σ p² + P/2) / (Σ q² + P)

- All of it counts as far as it would have brought the tip nearer. A share α of the corrections
  moved the tip by e_α, all of them would have moved it by e. The plan alone would have left
  a = tip − r̄ − e_α, and the share that would have left least is −Σ a·e / Σ e². Its standard
  deviation is taken off, by what is left and by how often corrections were tried.

Older instants count less, and 0 ≤ α, β ≤ 1. e is that of a limb that follows its pressures without
swinging, since statics are calibrated; what swings is smoothed away on both sides. Where a
disturbance changes faster than it can be seen and made up for, or a limb swings otherwise than its
model, corrections come in the wrong phase, α or β falls, and the plan is left alone.
"""

from __future__ import annotations

import math

import numpy as np

from der_planner.arrays import Array
from der_planner.control.nominal import Nominal
from der_planner.model import CONTROL_PERIOD

_SLOW = 0.4
"""Time constant of the low-pass that tells what is slow of a correction [s]."""
_SMOOTH = 0.3
"""Time constant of the two low-passes in front of α's sums [s]."""
_FORGET = 10.0
"""Time in which what corrections have brought is forgotten [s]."""
_FORGET_SWING = 3.0
"""Time in which predictions are forgotten [s]."""
_DOUBT = 0.001
"""√(P / 1 s), over the limb's length; P keeps α at 0 and β at a half until something was seen."""
_TRIED = 0.5
"""Time after which a correction is tried anew [s]."""


class Benefit:
    """Weighs corrections by what they have brought; see the module.

    Args:
        nominal: the model's motion under the plan.

    Attributes:
        share: α.
        swing_share: β.
    """

    def __init__(self, nominal: Nominal) -> None:
        self._nominal, inputs = nominal, nominal.model.inputs
        still = np.eye(2 * inputs) - nominal.transition
        self._bend = np.linalg.solve(still, nominal.input)[:, :inputs]
        of = nominal.model.air.pneumatics
        self._follows = _step(CONTROL_PERIOD, of.delay + of.time_constant)
        self._prior = (_DOUBT * nominal.model.limb.length) ** 2
        self._slow = np.zeros(inputs)
        self._pressure = np.zeros((2, inputs))
        # By period: what corrections have come to in the chambers, and the tip as it was expected
        # then, and as it was in the newest picture.
        self._held: dict[int, tuple[Array, Array]] = {}
        self._smooth = np.zeros((2, 2, 2))
        self._sums, self._predicted = np.zeros(4), np.zeros(2)
        self._seen = -1
        self.share, self.swing_share = 0.0, 0.5

    def see(self, k: int, missed: Array) -> None:
        """Take in the tip less r̄ (2,) [m] as a picture showed it in control period ``k``."""
        if k <= self._seen or k not in self._held:
            return
        passed = CONTROL_PERIOD * (k - self._seen if self._seen >= 0 else 1)
        self._seen = k
        pressure, expected = self._held[k]
        self._held = {j: held for j, held in self._held.items() if j > k}
        row = self._nominal.periods(k)
        jacobian = self._nominal.kinematics.tip_jacobians(self._nominal.bend[row])
        moved = pressure @ (jacobian @ self._bend[row]).T
        now = np.stack([missed - moved[0], moved[1]])
        for stage in self._smooth:
            stage += _step(passed, _SMOOTH) * (now - stage)
            now = stage
        alone, all_sent = now
        square = all_sent @ all_sent
        fresh = np.array([-alone @ all_sent, square, alone @ alone, square**2])
        self._sums += passed * fresh - _step(passed, _FORGET) * self._sums
        away = ((missed - expected) ** 2).sum(axis=1)
        self._predicted += passed * away - _step(passed, _FORGET_SWING) * self._predicted
        self._weigh()

    def _weigh(self) -> None:
        against, size, alone, fourth = self._sums
        best = against / (size + self._prior)
        left = max(alone - against * best, 0.0)
        tried = size**2 / max(fourth, 1e-30) / _TRIED
        doubt = math.sqrt(left / (size + self._prior) / max(tried, 1.0))
        self.share = min(max(best - doubt, 0.0), 1.0)
        missed, stayed = self._predicted + self._prior * np.array([0.5, 1.0])
        self.swing_share = min(max(1.0 - missed / stayed, 0.0), 1.0)

    def worth(self, corrections: Array) -> Array:
        """Return what is worth sending of the corrections (W, M) [Pa] from now on."""
        slow, share = self._slow, _step(CONTROL_PERIOD, _SLOW)
        worth = np.empty_like(corrections)
        for place, correction in enumerate(corrections):
            slow = slow + share * (correction - slow)
            worth[place] = slow + self.swing_share * (correction - slow)
        return worth

    def sent(
        self, k: int, wanted: Array, sent: Array, correction: Array, expected: Array
    ) -> None:
        """Note what is done in control period ``k``.

        Args:
            k: period.
            wanted: (M,) correction [Pa].
            sent: (M,) that is sent [Pa].
            correction: `worth` of what was wanted (M,) [Pa].
            expected: tip less r̄ as it is expected then, and in the newest picture (2, 2) [m].
        """
        self._slow = self._slow + _step(CONTROL_PERIOD, _SLOW) * (wanted - self._slow)
        self._held[k] = self._pressure, expected
        both = np.stack([sent, correction])
        self._pressure = self._pressure + self._follows * (both - self._pressure)


def _step(passed: float, time: float) -> float:
    """Return the share of a step that a low-pass has followed after a time [s]."""
    return 1.0 - math.exp(-passed / time)
