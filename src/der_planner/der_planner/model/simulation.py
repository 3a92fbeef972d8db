"""`simulate`: what a limb does under commands, or under pressures in its chambers.

Commands become chamber pressures by `air`, these become effective pressures by `material`, and the
rod or the arcs bend under the effective pressures. Nothing else in the project puts these three
together; planners go through a motion window by window with `Drive`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from der_planner.arrays import Array
from der_planner.limb import Limb
from der_planner.model.air import Chambers
from der_planner.model.material import Material
from der_planner.model.model import FirstOrder, Model, State

Bend = Callable[[Array], Array]
"""Bend angles (K, M) [rad] at instants (K,) [s]."""

CONTROL_PERIOD = 0.05
"""A command is held for this long [s]: setpoints are 50 ms apart."""
STEPS = 5
"""Integrator steps in a control period: 10 ms."""
_LONGEST_PERIOD = 1.0
"""Of instants that are told in seconds [s]."""


class Initial(NamedTuple):
    """What a simulation begins with.

    Attributes:
        state: of the model; None: at rest, vented, or under the first ``pressures``.
        before: (M,) command before the first one, which the chambers had reached [Pa]; None:
            vented.
    """

    state: State | None = None
    before: ArrayLike | None = None


AT_REST = Initial()


@dataclass(frozen=True)
class Derivative:
    """First-order change of tip and bend angles along one simulated motion of n intervals.

    Attributes:
        linear: of the model by its effective pressures.
        felt: takes a change (K, M) of the commands or pressures to those of the effective pressures
            (n, S, M), and of the first ones (M,) [Pa].
        start_slope: change of the pose at the beginning by the first effective pressures, under
            which it rests; None: the start is given.
        steps: S.
    """

    linear: FirstOrder
    felt: Callable[[Array], tuple[Array, Array]]
    start_slope: Array | None
    steps: int

    def tangent(self, change: ArrayLike) -> tuple[Array, Array]:
        """Return the changes of tip (n+1, 2) [m] and bend angles (n+1, M) [rad].

        Args:
            change: (K, M) of the commands or pressures [Pa].
        """
        return self._bent(*self.felt(np.asarray(change, dtype=float)))

    def by_effective(self, change: Array) -> tuple[Array, Array]:
        """Return the same for C changes (n+1, M, C) of the effective pressures at boundaries [Pa].

        Each interval changes by the mean of both ends, the start by the first row.
        """
        return self._bent(means_between(change, self.steps), change[0])

    def _bent(self, effective: Array, first: Array) -> tuple[Array, Array]:
        slope = self.start_slope
        return self.linear.tangent(effective, None if slope is None else slope @ first)


@dataclass(frozen=True)
class Response:
    """What a limb does in K intervals of equal length, S integrator steps each.

    Attributes:
        time: (K+1,) boundaries of the intervals [s].
        differential_pressure: (K, S, M) in the chambers, amid each integrator step [Pa].
        effective_pressure: (K, S, M) what the model bends under in each step [Pa].
        bend_angles: (K+1, M) [rad].
        tip: (K+1, 2) [m].
        begin, final: states at the beginning and at the end.
        derivative: by the commands or pressures that were given, if it was asked for.
    """

    time: Array
    differential_pressure: Array
    effective_pressure: Array
    bend_angles: Array
    tip: Array
    begin: State
    final: State
    derivative: Derivative | None = None


def simulate(
    model: Model | Limb,
    time: ArrayLike,
    *,
    commands: ArrayLike | None = None,
    pressures: ArrayLike | None = None,
    bend: Bend | None = None,
    initial: Initial = AT_REST,
    steps: int | None = None,
    linearise: bool = False,
) -> Response:
    """Simulate a limb under commands, or under the pressures that its chambers hold.

    Args:
        model: of the limb; a limb stands for its rod.
        time: (K,) regular instants [s].
        commands: (K, M) differential pressures that are commanded, each held for a period [Pa]: K
            intervals.
        pressures: (K, M) differential pressures in the chambers at the instants [Pa]: K − 1
            intervals, with the mean of both ends in each. Give these or ``commands``.
        bend: bend angles of the motion along which friction and creep act; None: along the bend at
            rest under the pressures (`Material.resting_bend`).
        initial: what is there at ``time[0]``.
        steps: S, integrator steps an interval; default 5 for commands, 1 for pressures.
        linearise: also give the derivative.

    Raises:
        ValueError: neither or both of commands and pressures, or shapes that do not fit.
        ConvergenceError: the rod could not be simulated.
    """
    if isinstance(model, Limb):
        model = Model.of(model)
    times = np.asarray(time, dtype=float)
    given = _check(commands, pressures, times, model.inputs)
    period = float(times[1] - times[0])
    if commands is not None:
        count = steps or STEPS
        felt = _from_commands(model, given, period, count, bend, initial)
        boundaries = np.append(times, times[-1] + period)
        begin: State = model.rest if initial.state is None else initial.state
    else:
        count = steps or 1
        felt = _from_pressures(model.material, times, given, count, bend)
        boundaries = times
        begin = model.resting(felt.first) if initial.state is None else initial.state
    moved = model.run(begin, felt.effective, period, "all" if linearise else "")
    derivative = None
    if moved.linear is not None:
        rests = commands is None and initial.state is None
        slope = model.rest_slope(begin, felt.first) if rests else None
        derivative = Derivative(moved.linear, felt.change, slope, count)
    return Response(
        boundaries,
        felt.differential,
        felt.effective,
        moved.bend_angles,
        moved.tip,
        begin,
        moved.final,
        derivative,
    )


def _check(
    commands: ArrayLike | None, pressures: ArrayLike | None, time: Array, inputs: int
) -> Array:
    if (commands is None) == (pressures is None):
        raise ValueError("give either commands or pressures")
    given = np.asarray(pressures if commands is None else commands, dtype=float)
    if time.ndim != 1 or time.size < 2 or given.shape != (time.size, inputs):
        raise ValueError(
            f"expected time (K,) of two instants or more and commands or pressures (K, {inputs}), "
            f"got {time.shape} and {given.shape}"
        )
    if not np.isfinite(given).all():
        row = int(np.flatnonzero(~np.isfinite(given).all(axis=1))[0])
        name = "pressures" if commands is None else "commands"
        raise ValueError(f"{name} must be finite [Pa], got {given[row]} in row {row}")
    if not np.allclose(np.diff(time), time[1] - time[0], rtol=1e-6, atol=1e-9):
        raise ValueError("the instants must be evenly spaced: resample the series first")
    if not 0.0 < time[1] - time[0] <= _LONGEST_PERIOD:
        raise ValueError(f"the instants are {time[1] - time[0]:g} s apart: give rising seconds")
    return given


class _Felt(NamedTuple):
    """What the limb feels.

    Attributes:
        effective: (n, S, M) [Pa].
        differential: (n, S, M) in the chambers [Pa].
        first: (M,) effective pressures at the first instant [Pa].
        change: see `Derivative`.
    """

    effective: Array
    differential: Array
    first: Array
    change: Callable[[Array], tuple[Array, Array]]


def _from_commands(
    model: Model, command: Array, period: float, steps: int, bend: Bend | None, initial: Initial
) -> _Felt:
    material, still = model.material, np.zeros(model.inputs)
    before = still if initial.before is None else np.array(initial.before, dtype=float)
    if before.shape != still.shape or not np.isfinite(before).all():
        raise ValueError(f"the command before is finite, of shape {still.shape}, got {before}")
    if bend is not None:
        window = Drive(model, bend, len(command), steps, before, period).window(command)

        def along_bend(change: Array) -> tuple[Array, Array]:
            differential = np.einsum("wsjm,jm->wsm", window.by_command(), change)
            return np.einsum("wsij,wsj->wsi", window.slopes, differential), still

        return _Felt(window.effective, window.differential, still, along_bend)
    chambers = model.air.follow(command, period, steps, before)
    shape, middle = chambers.differential.shape, step_middles(len(command), steps, period)
    flat = np.ascontiguousarray(chambers.differential.reshape(-1, model.inputs))
    effective = material.slow(middle, flat)

    def at_rest(change: Array) -> tuple[Array, Array]:
        differential = np.einsum("wsjm,jm->wsm", chambers.derivative(), change).reshape(flat.shape)
        return material.slow_change(middle, flat, differential).reshape(shape), still

    return _Felt(effective.reshape(shape), chambers.differential, still, at_rest)


def _from_pressures(
    material: Material,
    time: Array,
    pressure: Array,
    steps: int,
    bend: Bend | None,
) -> _Felt:
    if bend is None:
        effective = material.slow(time, pressure)
    else:
        taken = material.memory_pressures(time, bend(time))
        effective = material.without_memory(pressure, taken)

    def change(given: Array) -> tuple[Array, Array]:
        if bend is None:
            moved = material.slow_change(time, pressure, given)
        else:
            moved = np.einsum("kij,kj->ki", material.slopes(pressure, effective), given)
        return means_between(moved, steps), moved[0]

    differential = means_between(pressure, steps)
    return _Felt(means_between(effective, steps), differential, effective[0], change)


def step_middles(count: int, steps: int, period: float = CONTROL_PERIOD) -> Array:
    """Return the middles (count · steps,) of equal steps in ``count`` periods from 0 on [s]."""
    return (np.arange(count * steps, dtype=np.float64) + 0.5) * (period / steps)


def means_between(pressure: Array, steps: int) -> Array:
    """Return (K − 1, S, M, …) means of the pressures (K, M, …) at both ends of each interval."""
    return np.repeat((0.5 * (pressure[1:] + pressure[:-1]))[:, None], steps, axis=1)


# Window by window along a known bend -----------------------------------------------------------


@dataclass(frozen=True)
class Window:
    """Effective pressures under W commands in a row.

    Attributes:
        material: of the limb.
        chambers: what the chambers do under these and the commands before them.
        before: how many come before.
        effective: (W, S, M) effective pressure of each integrator step [Pa].
    """

    material: Material
    chambers: Chambers
    before: int
    effective: Array

    @property
    def differential(self) -> Array:
        """(W, S, M) pressure in the chambers amid each integrator step [Pa]."""
        return self.chambers.differential[self.before :]

    @cached_property
    def slopes(self) -> Array:
        """∂(effective)/∂(differential) (W, S, M, M) of each step, at a known bend."""
        return self.material.slopes(self.differential, self.effective)

    def by_command(self) -> Array:
        """Return ∂(differential pressure of a step)/∂command (W, S, W, M) within the window."""
        return self.chambers.derivative(self.before)


class Drive:
    """From K commands to the effective pressures of a limb, window by window.

    Friction and creep act along a known bend, so that what they take is computed once; the chambers
    are followed from as far back as they can remember.

    Args:
        model: of the limb.
        bend: of the motion.
        count: K.
        steps: S, integrator steps a command.
        before: (M,) command before the first one [Pa]; None: vented.
        period: of a command [s].
    """

    def __init__(
        self,
        model: Model,
        bend: Bend,
        count: int,
        steps: int,
        before: Array | None = None,
        period: float = CONTROL_PERIOD,
    ) -> None:
        self._air, self._material = model.air, model.material
        self.steps, self.before, self.period = steps, before, period
        self._remembered = int(np.ceil(model.air.memory / period))
        middle = step_middles(count, steps, period)
        taken = model.material.memory_pressures(middle, bend(middle))
        self._taken = taken.reshape(count, steps, -1)

    def window(self, command: Array, first: int = 0) -> Window:
        """Return what the limb feels from command ``first`` on.

        Args:
            command: (first + W, M) commands from the beginning [Pa].
            first: of the window.
        """
        begin = max(0, first - self._remembered)
        before = command[begin - 1] if begin else self.before
        chambers = self._air.follow(command[begin:], self.period, self.steps, before)
        differential = chambers.differential[first - begin :]
        effective = self._material.without_memory(differential, self._taken[first : len(command)])
        return Window(self._material, chambers, first - begin, effective)
