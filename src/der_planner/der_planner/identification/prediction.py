"""The rod's bend angles along the pressures of a log, and their derivatives by every unknown.

Friction and creep see the slow part of the predicted bend, never the measured one: what is left of
a measured angle would come back through them and take the blame off them. So a fit minimises just
the error with which the limb is predicted afterwards.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from der_planner.actuation import slow_effective_pressure
from der_planner.identification.parameters import TERMS, column, put, to_limb
from der_planner.limb import Limb
from der_planner.rod import Rod, Trajectory

Array = NDArray[np.float64]

NODES = 13
"""Of the rod in a fit: its statics do not depend on it, its first two frequencies by 2 %."""
SUBSTEPS = 1
"""Integrator steps of 50 ms: see the convergence on the page of the identification."""
_NUDGE = 1e-3
"""Of an unknown in its scale, for the slope of the effective pressure."""


class RodPrediction:
    """Predicts bend angles open loop along measured pressures.

    Args:
        prior: geometry, masses and everything that is not an unknown.
        time: (K,) regular [s].
        pressure: (K, M) measured differential pressures [Pa], without gaps.
        nodes: of the rod.
    """

    def __init__(self, prior: Limb, time: Array, pressure: Array, nodes: int = NODES) -> None:
        self._prior, self._time, self._nodes = prior, time, nodes
        self._pressure = pressure
        self._period = float(time[1] - time[0])

    def angles(self, values: Array) -> Array:
        """Return predicted bend angles (K, M) [rad] for the unknowns (M, T)."""
        rod, trajectory, _ = self._simulate(to_limb(self._prior, values))
        return bend_of(rod, trajectory.q)

    def tip(self, limb: Limb) -> Array:
        """Return predicted tips (K, 2) [m] of a limb."""
        _, trajectory, _ = self._simulate(limb)
        tip: Array = trajectory.tip[:, :2]
        return tip

    def derivatives(self, values: Array, wanted: list[tuple[int, int]]) -> tuple[Array, Array]:
        """Return angles (K, M) and their derivatives (K, M, P) by P unknowns.

        Args:
            values: (M, T) unknowns.
            wanted: (segment, term) of each of the P unknowns.

        What acts as a pressure goes through the rod's exact tangent; stiffness and damping, which
        change the rod itself, are differences of two simulations.
        """
        limb = to_limb(self._prior, values)
        rod, trajectory, effective = self._simulate(limb, linearise=True)
        angles = bend_of(rod, trajectory.q)
        start = _start_derivatives(rod, effective[0])
        result = np.empty((*angles.shape, len(wanted)))
        for place, (segment, term) in enumerate(wanted):
            if TERMS[term].group == "dynamics":
                result[:, :, place] = self._difference(values, segment, term, angles)
                continue
            change = self._pressure_change(values, segment, term)
            change[:, segment] += self._moment_change(
                values[segment], term, effective[:, segment], angles[:, segment]
            )
            shift = start @ change[0]
            result[:, :, place] = _bend_tangent(rod, trajectory, _mid(change), shift)
        return angles, result

    def effective(self, values: Array) -> Array:
        """Return the effective pressures (K, M) [Pa] of the unknowns (M, T)."""
        limb = to_limb(self._prior, values)
        return slow_effective_pressure(limb, self._time, self._pressure)

    def _simulate(self, limb: Limb, linearise: bool = False) -> tuple[Rod, Trajectory, Array]:
        """Return the rod, its motion and the effective pressures (K, M) that drove it [Pa]."""
        rod = Rod.from_limb(limb, self._nodes)
        effective = slow_effective_pressure(limb, self._time, self._pressure)
        trajectory = rod.simulate(
            rod.equilibrium(effective[0]),
            _mid(effective),
            self._period,
            substeps=SUBSTEPS,
            linearise=linearise,
            outputs=_outputs(rod) if linearise else None,
        )
        return rod, trajectory, effective

    def _difference(self, values: Array, segment: int, term: int, angles: Array) -> Array:
        step = TERMS[term].step
        moved = values.copy()
        put(moved, segment, term, float(values[segment, term]) + step)
        changed: Array = (self.angles(moved) - angles) / step
        return changed

    def _pressure_change(self, values: Array, segment: int, term: int) -> Array:
        """Return ∂(effective pressures)/∂unknown (K, M), by a difference of the closed form."""
        value, kind = float(values[segment, term]), TERMS[term]
        nudge = _NUDGE * kind.scale
        ends = (max(value - nudge, kind.low), min(value + nudge, kind.high))
        pressures = []
        for end in ends:
            moved = values.copy()
            put(moved, segment, term, end)
            pressures.append(self.effective(moved))
        slope: Array = (pressures[1] - pressures[0]) / (ends[1] - ends[0])
        return slope

    @staticmethod
    def _moment_change(row: Array, term: int, effective: Array, angle: Array) -> Array:
        """Return, as a pressure (K,), what an unknown does to the moments of the rod itself.

        A larger gain scales the moment, a rest angle shifts the elastic one, a cubic term adds to
        it: EI/L (φ + c φ³) with φ = θ − rest.
        """
        name, gain = TERMS[term].name, row[column("gain")]
        bent = angle - row[column("rest_angle")]
        if name == "gain":
            return np.asarray(effective / gain)
        if name == "rest_angle":
            return np.asarray((1.0 + 3.0 * row[column("cubic")] * bent**2) / gain)
        if name == "cubic":
            return np.asarray(-(bent**3) / gain)
        return np.zeros_like(effective)


def bend_of(rod: Rod, q: Array) -> Array:
    """Return bend angles (K, M) [rad] as tags see them: heading after less before."""
    headings = [_heading(q, a, b) for a, b in _edges(rod)]
    absolute = np.unwrap(np.stack(headings, axis=1), axis=0)
    relative: Array = np.diff(absolute, axis=1, prepend=0.0)
    return relative


def _mid(values: Array) -> Array:
    middle: Array = 0.5 * (values[1:] + values[:-1])
    return middle


def _edges(rod: Rod) -> list[tuple[int, int]]:
    """Return the nodes of the edge that carries the tag at the end of each segment."""
    last = len(rod.rest_lengths)
    ends = [min(first + count - 1, last - 1) for first, count in rod.segments]
    return [(end, end + 1) for end in ends]


def _outputs(rod: Rod) -> list[int]:
    return [4 * node + axis for edge in _edges(rod) for node in edge for axis in (0, 1)]


def _heading(q: Array, first: int, second: int) -> Array:
    dx = q[:, 4 * second] - q[:, 4 * first]
    dy = q[:, 4 * second + 1] - q[:, 4 * first + 1]
    heading: Array = np.arctan2(dy, dx)
    return heading


def _start_derivatives(rod: Rod, pressure: Array) -> Array:
    """Return the change (F, M) of the resting state's free coordinates per pressure [m/Pa]."""
    base = rod.equilibrium(pressure).q
    columns = []
    for index in range(len(pressure)):
        moved = pressure.copy()
        moved[index] += 10.0
        columns.append((rod.equilibrium(moved).q - base)[rod.free] / 10.0)
    return np.stack(columns, axis=1)


def _bend_tangent(rod: Rod, trajectory: Trajectory, change: Array, start: Array) -> Array:
    assert trajectory.linearisation is not None
    moved = trajectory.linearisation.tangent(change, (start, np.zeros_like(start)))
    columns = []
    for place, (a, b) in enumerate(_edges(rod)):
        x1, y1, x2, y2 = moved[:, 4 * place : 4 * place + 4].T
        dx = trajectory.q[:, 4 * b] - trajectory.q[:, 4 * a]
        dy = trajectory.q[:, 4 * b + 1] - trajectory.q[:, 4 * a + 1]
        columns.append((dx * (y2 - y1) - dy * (x2 - x1)) / (dx * dx + dy * dy))
    relative: Array = np.diff(np.stack(columns, axis=1), axis=1, prepend=0.0)
    return relative
