"""The exact first-order effect of commands or chamber pressures on tip and bend angles.

Three links make the chain: inputs to effective pressures (`Chain`, by `air` and `material`), the
state at rest under the first of them, and the model's own linearisation of its discrete motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.model import air, material
from der_planner.model.bending import bend_change, bend_gradient
from der_planner.model.drive import Window
from der_planner.pcc import Linearisation, Pcc
from der_planner.rod import Rod, RodState, Trajectory

Array = NDArray[np.float64]


class Chain(Protocol):
    """From K inputs (K, M) to effective pressures of n intervals (n, S, M), with derivatives."""

    @property
    def effective(self) -> Array:
        """(n, S, M) [Pa]."""

    @property
    def differential(self) -> Array:
        """(n, S, M) in the chambers [Pa]."""

    def tangent(self, change: Array) -> tuple[Array, Array]:
        """Return the changes of the effective pressures (n, S, M), and at the start (M,) [Pa]."""

    def adjoint(self, weight: Array, start: Array) -> Array:
        """Return the gradient (K, M) of Σ weight · effective + start · (effective at the start)."""


@dataclass(frozen=True)
class OfWindow:
    """Commands along a known bend."""

    effective: Array
    differential: Array
    window: Window

    def tangent(self, change: Array) -> tuple[Array, Array]:
        """Return the changes of the effective pressures; that at the start is zero."""
        held = np.einsum("wsjm,jm->wsm", self.window.by_command(), change)
        return self.window.slopes.tangent(held), np.zeros(change.shape[1])

    def adjoint(self, weight: Array, start: Array) -> Array:  # noqa: ARG002 - it does not change
        """Return the gradient (K, M) by the commands."""
        held = self.window.slopes.adjoint(weight)
        gradient: Array = np.einsum("wsjm,wsm->jm", self.window.by_command(), held)
        return gradient


@dataclass(frozen=True)
class OfInstants:
    """Effective pressures that are computed at instants, along the bend at rest or a known one.

    With ``chambers`` the inputs are commands and the instants the middles of the integrator steps;
    without, the inputs are chamber pressures at the K instants, and the mean of both ends drives
    each of the K − 1 intervals.
    """

    effective: Array
    differential: Array
    slopes: Callable[[], material.SlowSlopes | material.Slopes]
    chambers: air.Chambers | None = None

    def tangent(self, change: Array) -> tuple[Array, Array]:
        """Return the changes of the effective pressures, and at the start (M,) [Pa]."""
        slopes, inputs = self.slopes(), change.shape[1]
        if self.chambers is not None:
            held = np.einsum("wsjm,jm->wsm", air.derivative(self.chambers), change)
            moved = slopes.tangent(held.reshape(-1, inputs))
            return moved.reshape(self.effective.shape), np.zeros(inputs)
        moved = slopes.tangent(change)
        middle = 0.5 * (moved[1:] + moved[:-1])
        return np.repeat(middle[:, None, :], self.effective.shape[1], axis=1), moved[0]

    def adjoint(self, weight: Array, start: Array) -> Array:
        """Return the gradient (K, M) by the commands or chamber pressures."""
        slopes, inputs = self.slopes(), weight.shape[2]
        if self.chambers is not None:
            held = slopes.adjoint(weight.reshape(-1, inputs)).reshape(weight.shape)
            gradient: Array = np.einsum("wsjm,wsm->jm", air.derivative(self.chambers), held)
            return gradient
        middle = 0.5 * weight.sum(axis=1)
        at_instants = np.zeros((len(middle) + 1, inputs))
        at_instants[1:] += middle
        at_instants[:-1] += middle
        at_instants[0] += start
        return slopes.adjoint(at_instants)


class Slopes(Protocol):
    """First-order change of a simulated motion of n intervals by its effective pressures."""

    def tangent(self, effective: Array, first: Array) -> tuple[Array, Array]:
        """Return the changes of tip (n+1, 2) [m] and bend angles (n+1, M) [rad].

        Args:
            effective: (n, S, M) change of the effective pressures [Pa].
            first: (M,) change of those under which the model rests at the beginning [Pa].
        """

    def adjoint(self, tip: Array | None, bend_angles: Array | None) -> tuple[Array, Array]:
        """Return the gradients (n, S, M) and (M,) of Σ weight · output by the same two."""


class RodSlopes:
    """`Slopes` of the rod.

    Args:
        rod: that moved.
        motion: linearised for the tip's x and y and the coordinates of the bend angles.
        at_rest: state at the beginning and the effective pressures (M,) under which it rests [Pa],
            where these are the first of the motion's; None: the start does not change.
    """

    def __init__(
        self, rod: Rod, motion: Trajectory, at_rest: tuple[RodState, Array] | None = None
    ) -> None:
        if motion.linearisation is None:
            raise ValueError("the motion must be simulated with linearise=True")
        self._rod, self._motion, self._linear = rod, motion, motion.linearisation
        self._start = None if at_rest is None else rod.linearise_equilibrium(*at_rest)[rod.free]

    def tangent(self, effective: Array, first: Array) -> tuple[Array, Array]:
        """Return the changes of tip and bend angles."""
        moved = self._linear.tangent(effective, self._shift(first))
        return moved[:, :2], bend_change(self._rod, self._motion.q, moved[:, 2:])

    def adjoint(self, tip: Array | None, bend_angles: Array | None) -> tuple[Array, Array]:
        """Return the gradients by the pressures of the steps, and by those of the start."""
        count, inputs = len(self._motion.q), self._rod.segment_count
        weight = np.zeros((count, 2 + 4 * inputs))
        if tip is not None:
            weight[:, :2] = tip
        if bend_angles is not None:
            weight[:, 2:] = bend_gradient(self._rod, self._motion.q, bend_angles)
        by_step = self._linear.adjoint(weight, by_step=True)
        first = np.zeros(inputs)
        if self._start is not None:
            still = np.zeros_like(by_step)
            for j in range(inputs):
                shift = self._shift(np.eye(inputs)[j])
                first[j] = float((weight * self._linear.tangent(still, shift)).sum())
        return by_step, first

    def _shift(self, first: Array) -> tuple[Array, Array] | None:
        if self._start is None:
            return None
        moved = self._start @ first
        return moved, np.zeros_like(moved)


class ArcSlopes:
    """`Slopes` of the arcs.

    Args:
        pcc: that moved.
        angles: (n+1, M) bend angles of the motion [rad].
        linear: its linearisation.
        at_rest: whether the motion begins at rest under its first pressures.
    """

    def __init__(self, pcc: Pcc, angles: Array, linear: Linearisation, *, at_rest: bool) -> None:
        self._linear = linear
        self._jacobian = pcc.tip_jacobian(angles)
        self._start: Array = np.zeros((pcc.segment_count, pcc.segment_count))
        if at_rest:
            stiffness = pcc.stiffness_matrix(angles[0])
            self._start = np.asarray(np.linalg.solve(stiffness, np.diag(pcc.gain)))

    def tangent(self, effective: Array, first: Array) -> tuple[Array, Array]:
        """Return the changes of tip and bend angles."""
        moved = self._linear.tangent(effective, self._start @ first)
        return np.einsum("kan,kn->ka", self._jacobian, moved), moved

    def adjoint(self, tip: Array | None, bend_angles: Array | None) -> tuple[Array, Array]:
        """Return the gradients by the pressures of the steps, and by those of the start."""
        weight = np.zeros((len(self._jacobian), self._jacobian.shape[2]))
        if tip is not None:
            weight += np.einsum("kan,ka->kn", self._jacobian, tip)
        if bend_angles is not None:
            weight += bend_angles
        by_step, start = self._linear.adjoint(weight)
        return by_step, self._start.T @ start


class Derivative:
    """First-order change of tip and bend angles along one simulated motion.

    Args:
        slopes: of the model by its effective pressures.
        chain: from the inputs to the effective pressures.
    """

    def __init__(self, slopes: Slopes, chain: Chain) -> None:
        self._slopes, self._chain = slopes, chain

    def tangent(self, change: ArrayLike) -> tuple[Array, Array]:
        """Return the changes of tip (n+1, 2) [m] and bend angles (n+1, M) [rad].

        Args:
            change: (K, M) of the commands or pressures [Pa].
        """
        return self._slopes.tangent(*self._chain.tangent(np.asarray(change, dtype=float)))

    def by_effective(self, change: Array) -> tuple[Array, Array]:
        """Return the same for changes (n+1, M) of the effective pressures at the boundaries [Pa].

        Each interval changes by the mean of both ends, the start by the first row.
        """
        middle = 0.5 * (change[1:] + change[:-1])
        steps = self._chain.effective.shape[1]
        return self._slopes.tangent(np.repeat(middle[:, None, :], steps, axis=1), change[0])

    def adjoint(self, tip: ArrayLike | None = None, bend_angles: ArrayLike | None = None) -> Array:
        """Return the gradient (K, M) of Σ weight · tip + Σ weight · bend angle, by the inputs.

        Args:
            tip: (n+1, 2) weights of the tip; None: none.
            bend_angles: (n+1, M) weights of the bend angles; None: none.
        """
        weights = [None if w is None else np.asarray(w, dtype=float) for w in (tip, bend_angles)]
        return self._chain.adjoint(*self._slopes.adjoint(*weights))
