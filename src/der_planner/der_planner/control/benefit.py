"""How much of feedback's corrections is worth sending: what they have brought, in hindsight.

The horizon wants corrections, and a share α of them is sent. What was sent has moved the tip by
e_α; all that was wanted would have moved it by e. With the measured tip and its reference r̄, the
error without corrections would have been tip − r̄ − e_α. The share that would have left least of it
is

    α = − Σ (tip − r̄ − e_α)·e / (Σ e² + P)

The sums are over what was seen until now; older instants count less. P is small, and keeps α at
zero until something was seen. The standard deviation of this estimate follows from what α would
have left, and from how many instants are independent. Some standard deviations are taken off, and
the result is kept within 0 … 1.

e and e_α are those of a limb that follows its pressures without swinging, since statics are
calibrated. Swings are smoothed away on both sides. Where a disturbance changes faster than it can
be seen and made up for, or where corrections bend the limb otherwise than the model, they come in
the wrong phase: α falls, and the plan is left alone.
"""

from __future__ import annotations

import math

import numpy as np

from der_planner.arrays import Array
from der_planner.estimation.nominal import Nominal
from der_planner.model import CONTROL_PERIOD

_SMOOTH = 0.3
"""Time constant of the two low-passes in front of the sums [s]."""
_FORGET = 20.0
"""Time in which what corrections have brought is forgotten [s]."""
_INDEPENDENT = 0.8
"""Time after which an instant says something new of the share [s]."""
_DEVIATIONS, _DEVIATIONS_QUICK = 2.0, 3.0
"""Standard deviations of the share that are taken off it, and those that a quick motion adds.

In a quick motion what a correction brings differs most from one second to the next.
"""
_RISES, _RISES_QUICK = 1.5, 3.0
"""Time in which the share may rise from 0 to 1, and the time that a quick motion adds [s].

A sudden correction makes a limb swing.
"""
_QUICK = 0.8
"""Root mean square of a quick motion's bend rates, over that of its bend from the mean [1/s]."""
_OUTLYING = 9.0
"""Largest squared error that an instant counts with, over the usual one."""
_LEAST_SLOW = 0.1
"""Slowness, 0 … 1, that is added to that of two motions before they are divided."""
_LEAVES = 0.25
"""Share of the largest bend, both from where the plan begins, from which on earlier runs count.

A limb that has rested sticks there as it does nowhere else. A correction that grew meanwhile would
make it jump once it comes loose.
"""
_DOUBT = 0.001
"""√P over the limb's length [√s].

What corrections bring counts once it would have moved the tip by about so much for a second.
"""


class Benefit:
    """Weighs corrections by what they have brought; see the module.

    Args:
        nominal: the model's motion under the plan.

    Attributes:
        share: α.
    """

    def __init__(self, nominal: Nominal) -> None:
        self._nominal, inputs = nominal, nominal.model.inputs
        still = np.eye(2 * inputs) - nominal.fine_transition
        self._bend = np.linalg.solve(still, nominal.fine_input)[:, :inputs]
        of = nominal.model.air.pneumatics
        self._follows = _step(CONTROL_PERIOD, of.delay + of.time_constant)
        # What corrections that are sent, and all of them, have come to in the chambers: by period.
        self._pressure = np.zeros((2, inputs))
        self._held: dict[int, Array] = {}
        self._smooth = np.zeros((2, 2, 2))
        # Of −alone·wanted, wanted², alone² and 1 over time.
        self._sums, self._earlier = np.zeros((2, 4))
        away = np.abs(nominal.bend - nominal.bend[0]).max(axis=1)
        self._leaves = int(np.argmax(away >= _LEAVES * away.max()))
        moved = nominal.bend - nominal.bend.mean(axis=0)
        rates = np.gradient(nominal.bend, CONTROL_PERIOD, axis=0)
        quick = float(np.sum(rates**2) / max(np.sum(moved**2), 1e-12)) / _QUICK**2
        self._slow = max(0.0, 1.0 - quick**2)
        self._rises = _RISES + (1.0 - self._slow) * _RISES_QUICK
        self._deviations = _DEVIATIONS + (1.0 - self._slow) * _DEVIATIONS_QUICK
        self._prior = (_DOUBT * nominal.model.limb.length) ** 2
        self._seen = -1
        self.share = 0.0

    def remember(self, other: Benefit) -> None:
        """Begin with what corrections brought in an earlier run of this limb.

        It counts once the plan has left where it begins. The quicker the motion, the less of it
        holds again.
        """
        self._earlier = self._slow * (other._sums + other._earlier)

    def take_over(self, other: Benefit) -> None:
        """Go on where the corrections of another plan of this limb were.

        What a slower motion has told counts as much less as this one is quicker.
        """
        kept = min(1.0, (self._slow + _LEAST_SLOW) / (other._slow + _LEAST_SLOW))
        self._sums, self.share = kept * other._sums, other.share
        self._pressure = other._pressure

    def sent(self, k: int, sent: Array, wanted: Array) -> None:
        """Note the correction that is sent and that which is wanted (M,) [Pa] in a period."""
        both = np.stack([sent, wanted])
        self._pressure = self._pressure + self._follows * (both - self._pressure)
        self._held[k + 1] = self._pressure

    def see(self, k: int, missed: Array) -> None:
        """Take in the tip less r̄ (2,) [m] as it was seen in control period ``k``."""
        if k <= self._seen or k not in self._held:
            return
        passed = CONTROL_PERIOD * (k - self._seen if self._seen >= 0 else 1)
        self._seen, pressure = k, self._held[k]
        if k >= self._leaves:
            self._sums, self._earlier = self._sums + self._earlier, np.zeros(4)
        self._held = {j: held for j, held in self._held.items() if j > k}
        row = self._nominal.periods(k)
        jacobian = self._nominal.kinematics.tip_jacobians(self._nominal.bend[row])
        moved = pressure @ (jacobian @ self._bend[row]).T
        now = np.stack([missed - moved[0], moved[1]])
        for stage in range(len(self._smooth)):
            self._smooth[stage] += _step(passed, _SMOOTH) * (now - self._smooth[stage])
            now = self._smooth[stage]
        alone, wanted = now
        fresh = np.array([-alone @ wanted, wanted @ wanted, alone @ alone, 1.0])
        # Swings after a push would drown for long what was brought before and after.
        usual = max(self._sums[2] / max(self._sums[3], 1.0), self._prior)
        fresh *= min(1.0, _OUTLYING * usual / max(float(fresh[2]), usual))
        counts = min(passed, _SMOOTH)  # of a time in which nothing was seen little is known
        self._sums = self._sums + counts * fresh - _step(counts, _FORGET) * self._sums
        brought, asked, lacked, watched = self._sums
        share = brought / (asked + self._prior)
        doubt = max(lacked - share * brought, 0.0) / (asked + self._prior)
        others = max(watched / _INDEPENDENT - 1.0, 1e-9)
        share -= self._deviations * math.sqrt(doubt / others)
        most = min(1.0, self.share + passed / self._rises)
        self.share = min(max(float(share), 0.0), most)


def _step(passed: float, time: float) -> float:
    """Return the share of a step that a low-pass has followed after a time [s]."""
    return 1.0 - math.exp(-passed / time)
