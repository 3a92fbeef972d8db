"""What the model expects along a plan: its motion, how small deviations move, its chambers.

The rod is rolled forward once under the plan's own commands. Around this motion the limb is a
linear system of second order in its M bend angles,

    M_w δθ̈ + D_w δθ̇ + K_w δθ = δw

with δw the change of the effective pressures [Pa]. M_w, D_w and K_w are the derivatives of the
projected balance of forces (`model.rod.Balance`) by acceleration, rate and bend along the motion,
so that weight and pose count. Friction and creep are part of δw.

`ChamberLog` keeps what was commanded and measured of the chambers, and expects what comes.
"""

from __future__ import annotations

import bisect
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import make_interp_spline
from scipy.linalg import expm

from der_planner.arrays import Array, interpolate
from der_planner.methods import LEARNED
from der_planner.model import CONTROL_PERIOD, STEPS, Initial, RodModel, simulate
from der_planner.model.air import Chambers
from der_planner.model.simulation import step_middles
from der_planner.planning.plan_file import Plan
from der_planner.planning.timing import resting_spline, sample_spline

Whole = NDArray[np.signedinteger[Any]]

STEP = CONTROL_PERIOD / STEPS
"""Fine step [s]: the grid of the estimator; `STEPS` of them make a control period."""
_HOLD = 40
"""Control periods after the plan's end for which the model is rolled on; what comes later is as
the last of them."""
_SEGMENTS_KNOWN = 0.02
"""Where a bend moves the tip by less than this per radian, a tip error says nothing about it
[m/rad]."""
_CHANGES = (1e-4, 1e-2, 1e-1)
"""Changes of bend, rate and acceleration for finite differences [rad], [rad/s], [rad/s²]."""

_GAP_TIME = 10.0
"""Time in which a difference between measured and modelled pressures is expected to fade [s]."""
_GROWTH_TIME = 0.5
"""Time in which the growth of that difference fades [s]."""
_GROWTH_SEEN = 0.3
"""Span of the last readings from which that growth is taken [s]."""
_LONGEST_HOLD = 40
"""Number of control periods without a command after which the plan's commands count again."""
_BEFORE = 60
"""Number of control periods before the first setpoint in which the limb may be watched."""
_GROWTH = 200
"""Number of control periods by which the table of commands grows."""
_KEPT = 6.0
"""Age up to which measured pressures are kept [s]."""


class Nominal:
    """The motion of the model under the commands of a plan, K control periods and a hold after it.

    Instants are counted in fine steps j (`STEP`) or control periods k from the first setpoint;
    before the first and after the last the limb rests, and every table is read at its end.

    Args:
        plan: whose commands, reference and limb are taken.

    Attributes:
        model: rod of the plan's limb.
        kinematics: of the rod's evenly bent segments.
        commands: (K', M) of the plan, then held [Pa].
        reference: (K', 2) r̄ [m].
        tip: (K', 2) of the model at the setpoints, with what a learned plan knows of it [m].
        bend: (K', M) of the model at the setpoints [rad].
        before: (M,) command before the first one [Pa].
        fine_bend: (K'·STEPS, M) bend of the model amid the fine steps [rad].
        effective: (K'·STEPS, M) effective pressures of the fine steps [Pa].
        taken: (K'·STEPS, M) pressures that friction and creep take of them [Pa].
        is_learned: whether the plan was learned.
        watched: whether readings of the chambers are compared with the model: not on a learned plan
            that does not say what its chambers hold beyond their model.
        fine_transition, fine_input: (K', 2M, 2M) and (K', 2M, M) of (δθ, δθ̇) in one fine step.
        free: (2M, 2M) transition in a fine step in which no forces act.
        mass: (K', M, M) M_w [Pa s²].
    """

    def __init__(self, plan: Plan) -> None:
        model = plan.body if isinstance(plan.body, RodModel) else RodModel(plan.limb)
        self.model = model
        self.kinematics = model.kinematics
        self.commands = _held(plan.differential_pressure)
        count = len(self.commands)
        time = np.arange(count, dtype=np.float64) * CONTROL_PERIOD
        start = plan.reference.start
        spline = resting_spline(plan.time, plan.bend_angles, start)
        self.before = np.zeros(plan.limb.segment_count) if start is None else start.pressure
        response = simulate(
            model,
            time,
            commands=self.commands,
            bend=lambda instants: sample_spline(spline, instants)[0],
            initial=Initial(
                None if start is None else model.state(spline(0.0), spline(0.0, 1)), self.before
            ),
        )
        self.reference = _held(plan.tip_reference)
        known = np.zeros_like(self.reference)
        if plan.model == "der":  # what a learned plan expects beyond the model; its end stays
            known = _held(plan.tip_predicted - response.tip[: len(plan.time)])
        tip, bend = response.tip[:-1] + known, response.bend_angles[:-1]
        bend = bend + self._bend_of(bend, known)
        self.bend, self.tip = bend, tip
        self._bend_spline = make_interp_spline(time, bend, k=3)
        self._tip_spline = make_interp_spline(time, tip, k=3)
        self._last = float(time[-1])
        inputs = plan.limb.segment_count
        self.effective = response.effective_pressure.reshape(-1, inputs)
        middle = step_middles(count, STEPS)
        # Near the straight limb it bends otherwise than it was planned to, with the same tip.
        self.fine_bend = self.at(middle)[0]
        self.taken = model.material.memory_pressures(middle, self.fine_bend)
        beyond = plan.chambers_beyond
        self.is_learned = plan.method.startswith(LEARNED)
        self.watched = beyond is not None or not self.is_learned
        self._beyond = np.zeros((1, inputs)) if beyond is None else beyond
        self._linearise(time)

    @property
    def count(self) -> int:
        """K', control periods with tables of their own."""
        return len(self.commands)

    def at(self, time: ArrayLike) -> tuple[Array, Array, Array]:
        """Return bend angles, rates (…, M) and tip (…, 2) at instants [s]."""
        instants = np.asarray(time, dtype=float)
        clipped = np.clip(instants, 0.0, self._last)
        moving = (instants == clipped)[..., None]
        rate = np.where(moving, self._bend_spline(clipped, 1), 0.0)
        return self._bend_spline(clipped), rate, self._tip_spline(clipped)

    def periods(self, k: int | Whole) -> Whole:
        """Return control periods cut to those with tables."""
        return np.clip(k, 0, self.count - 1)

    def steps(self, j: int | Whole) -> Whole:
        """Return fine steps cut to those with tables."""
        return np.clip(j, 0, self.count * STEPS - 1)

    def command(self, k: int) -> Array:
        """Return the plan's command (M,) of a control period [Pa]."""
        return self.before if k < 0 else self.commands[min(k, self.count - 1)]

    def chambers_beyond(self, time: Array) -> Array:
        """Return what the chambers are known to hold beyond their model (n, M) at instants [s]."""
        middle = (np.arange(len(self._beyond)) + 0.5) * CONTROL_PERIOD
        return interpolate(time, middle, self._beyond)

    def moves(self, k: Whole, stiffness_ratio: float) -> tuple[Array, Array]:
        """Return transitions (W, 2M, 2M) and inputs (W, 2M, M) of (δθ, δθ̇) in control periods (W,).

        Args:
            k: the periods.
            stiffness_ratio: how many times stiffer than the model the limb is, gains as well.
        """
        forced = np.concatenate([self.fine_transition[k] - self.free, self.fine_input[k]], axis=2)
        step = np.tile(np.eye(forced.shape[2]), (len(k), 1, 1))
        both = len(self.free)
        step[:, :both, :both] = self.free
        step[:, :both] += stiffness_ratio * forced
        whole = np.linalg.matrix_power(step, STEPS)
        return whole[:, :both, :both], whole[:, :both, both:]

    def moved_tip(self, bend: Array, change: Array) -> Array:
        """Return by how much the tip moves (…, 2) [m] if bend angles (…, M) change [rad]."""
        return self.kinematics.tip(bend + change) - self.kinematics.tip(bend)

    def _bend_of(self, bend: Array, moved: Array) -> Array:
        """Return changes of bend (K', M) [rad] that move the tip by (K', 2) [m].

        As far as the tip tells them.
        """
        jacobian = self.kinematics.tip_jacobians(bend)
        square = np.einsum("kai,kaj->kij", jacobian, jacobian)
        square += _SEGMENTS_KNOWN**2 * np.eye(bend.shape[1])
        return np.linalg.solve(square, np.einsum("kai,ka->ki", jacobian, moved)[..., None])[..., 0]

    def _linearise(self, time: Array) -> None:
        balance = self.model.balance.projected
        motion = np.stack([self._bend_spline(time, order) for order in range(3)])
        count, inputs = motion.shape[1:]

        def slope(order: int, size: float) -> Array:
            """Return ∂balance/∂(bend, rate or acceleration) (K', M, M) by finite differences."""
            columns = []
            for unit in np.eye(inputs):
                step = np.zeros_like(motion)
                step[order] = size * unit
                columns.append((balance(*motion + step) - balance(*motion - step)) / (2 * size))
            return np.stack(columns, axis=2)

        stiffness, damping, mass = (slope(*each) for each in enumerate(_CHANGES))
        system = np.zeros((count, 3 * inputs, 3 * inputs))
        rates = slice(inputs, 2 * inputs)
        system[:, :inputs, rates] = np.eye(inputs)
        system[:, rates, :inputs] = -np.linalg.solve(mass, stiffness)
        system[:, rates, rates] = -np.linalg.solve(mass, damping)
        system[:, rates, 2 * inputs :] = np.linalg.inv(mass)
        both = 2 * inputs
        fine = expm(system * STEP)
        self.fine_transition, self.fine_input = fine[:, :both, :both], fine[:, :both, both:]
        self.free = np.eye(both) + STEP * np.eye(both, k=inputs)
        self.mass = mass


def _held(rows: Array) -> Array:
    """Return the rows (K, n) of a plan's setpoints with the last of them held (K', n)."""
    return np.concatenate([rows, np.repeat(rows[-1:], _HOLD, axis=0)])


class ChamberLog:
    """Chamber pressures of the past as measured, of the future by the law of the air.

    Between two readings the pressures are on a straight line. After the last one the model's
    pressures under the commands hold, with the difference that the last readings showed. What a
    learned plan knows its chambers to hold beyond their model is left out of all of them: the tip
    that the plan expects has it already.

    Args:
        nominal: of the plan.
        kept: readings are kept for this long [s].
    """

    def __init__(self, nominal: Nominal, kept: float = _KEPT) -> None:
        self._nominal, self._kept = nominal, kept
        self._inputs = nominal.model.inputs
        self._times: list[float] = []
        self._readings: list[Array] = []
        self._gap: tuple[Array, Array] | None = None
        self._last: int | None = None
        self._remembered = int(np.ceil(nominal.model.air.memory / CONTROL_PERIOD))
        self._origin = -self._remembered - _BEFORE
        self._commands = np.tile(nominal.before, (-self._origin, 1))

    @property
    def newest(self) -> float:
        """Instant of the newest reading [s]; −∞: none."""
        return self._times[-1] if self._times else -np.inf

    def read(self, time: float, differential: ArrayLike) -> float | None:
        """Keep a reading (M,) [Pa]; return from when on pressures changed by it [s], None: nowhere.

        Raises:
            ValueError: the reading has another shape.
        """
        values = np.asarray(differential, dtype=float)
        if values.shape != (self._inputs,):
            raise ValueError(
                f"expected {self._inputs} differential pressures, got shape {values.shape}"
            )
        if not np.isfinite(values).all():
            return None
        place = bisect.bisect_left(self._times, time)
        if place < len(self._times) and self._times[place] == time:
            self._readings[place] = values
        else:
            self._times.insert(place, time)
            self._readings.insert(place, values)
        while self._times[0] < self._times[-1] - self._kept:
            del self._times[0], self._readings[0]
            place -= 1
        self._gap = None
        return self._times[place - 1] if place > 0 else time

    def take_over(self, other: ChamberLog, periods: int) -> None:
        """Go on from the log of another plan, whose control period ``periods`` is this one's 0."""
        self._times = [time - periods * CONTROL_PERIOD for time in other._times]
        self._readings = list(other._readings)
        self._commands = np.array([other.sent(periods + k) for k in range(self._origin, 0)])
        self._last, self._gap = -1, None

    def send(self, k: int, command: Array) -> None:
        """Keep the command (M,) [Pa] of control period ``k``; it held since the last one sent."""
        table = self._table(k)
        row = k - self._origin
        if self._last is not None and 0 < k - self._last <= _LONGEST_HOLD:
            last = self._last - self._origin
            table[last + 1 : row] = table[last]
        table[row] = command
        self._last = k if self._last is None else max(k, self._last)
        self._gap = None

    def sent(self, k: int) -> Array:
        """Return the command (M,) of a control period [Pa]; the plan's if none was sent."""
        row: Array = self._table(k)[max(k - self._origin, 0)]
        return row

    def _table(self, k: int) -> Array:
        """Return the commands from period ``_origin`` on, to ``k`` and beyond."""
        missing = k + 1 - self._origin - len(self._commands)
        if missing > 0:
            first = self._origin + len(self._commands)
            more = [self._nominal.command(j) for j in range(first, first + missing + _GROWTH)]
            self._commands = np.concatenate([self._commands, np.array(more)])
        return self._commands

    def follow(self, first: int, coming: Array) -> tuple[Chambers, int]:
        """Return the chambers under the commands sent before period ``first`` and the coming ones.

        Args:
            first: period of the first coming command.
            coming: (W, M) [Pa].

        Returns:
            The chambers, and how many periods of them come before ``first``.
        """
        begin = max(first - self._remembered, self._origin + 1)
        table = self._table(first)
        past = table[begin - self._origin : first - self._origin]
        chambers = self._nominal.model.air.follow(
            np.concatenate([past, coming]),
            CONTROL_PERIOD,
            STEPS,
            self.sent(begin - 1),
        )
        return chambers, first - begin

    def during(self, steps: Whole) -> Array:
        """Return the differential pressures (n, M) [Pa] amid consecutive fine steps (n,)."""
        middle = STEP * (steps.astype(np.float64) + 0.5)
        known = (middle <= self.newest) & self._nominal.watched
        result = np.empty((len(steps), self._inputs))
        if known.any():
            readings = interpolate(middle[known], np.array(self._times), np.array(self._readings))
            result[known] = readings - self._nominal.chambers_beyond(middle[known])
        if not known.all():
            coming = self.model(steps[~known])
            coming += self.expected_gap(middle[~known])
            result[~known] = coming
        return result

    def model(self, steps: Whole) -> Array:
        """Return the modelled differential pressures (n, M) [Pa] amid fine steps (n,)."""
        first, last = int(steps[0]) // STEPS, int(steps[-1]) // STEPS
        coming = self._table(last)[first - self._origin : last + 1 - self._origin]
        chambers, before = self.follow(first, coming)
        differential = chambers.differential[before:].reshape(-1, self._inputs)
        return differential[steps - first * STEPS]

    def expected_gap(self, time: Array) -> Array:
        """Return the expected differences (n, M) [Pa] of the chambers from their model.

        The difference of the last reading fades within `_GAP_TIME`; first it goes on growing as it
        did in the last readings, for about `_GROWTH_TIME`: a chamber that vents more slowly than
        its model is left behind further and further.

        Args:
            time: (n,) instants after the last reading [s].
        """
        if not self._times or not self._nominal.watched:
            return np.zeros((len(time), self._inputs))
        if self._gap is None:
            self._gap = self._last_gap()
        gap, growth = self._gap
        ahead = (time - self._times[-1])[:, None]
        grown = _GROWTH_TIME * (1.0 - np.exp(-ahead / _GROWTH_TIME))
        return np.exp(-ahead / _GAP_TIME) * gap + grown * growth

    def _last_gap(self) -> tuple[Array, Array]:
        """Return the last reading less the model (M,) [Pa], and how fast that grows [Pa/s]."""
        last = self._times[-1]
        begin = bisect.bisect_left(self._times, last - _GROWTH_SEEN)
        instants = np.array(self._times[begin:])
        steps = np.arange(
            int(np.floor(instants[0] / STEP - 0.5)), int(np.floor(last / STEP - 0.5)) + 2
        )
        middles = STEP * (steps.astype(np.float64) + 0.5)
        gaps = np.array(self._readings[begin:]) - interpolate(instants, middles, self.model(steps))
        gaps -= self._nominal.chambers_beyond(instants)
        away = instants - last
        if len(away) < 3 or np.ptp(away) < _GROWTH_SEEN / 2:
            return gaps[-1], np.zeros(self._inputs)
        slope = (away - away.mean()) @ (gaps - gaps.mean(axis=0)) / np.var(away) / len(away)
        return gaps[-1], slope
