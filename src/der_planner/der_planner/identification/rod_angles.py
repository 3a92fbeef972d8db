"""The rod's bend angles along the pressures of a log, and their derivatives by every unknown.

Friction and creep act along the bend at rest that the pressures give, never along the measured one.
So a fit minimises the same open-loop error with which the limb is predicted afterwards; with the
measured bend inside the model, an error of friction would partly cancel itself in the residual.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from der_planner.identification.parameters import TERMS, column, put, to_limb
from der_planner.limb import Limb
from der_planner.model import Response, RodModel, simulate
from der_planner.model.material import Material

Array = NDArray[np.float64]

NODES = 13
"""Nodes of the rod in a fit. Its statics do not depend on them, its first two natural frequencies
change by 2 %."""
SUBSTEPS = 1
"""Integrator steps in each row of 50 ms; the page of the identification shows the convergence."""
_NUDGE = 1e-3
"""Change of an unknown, in units of its scale, for the slope of the effective pressure."""
_STEP = 0.1
"""Change of an unknown, in units of its scale, for the difference of two simulations."""


class Predicted(NamedTuple):
    """What a rod does along a log of K rows, and the derivatives by P unknowns.

    Attributes:
        angles: (K, M) bend angles [rad].
        tip: (K, 2) [m].
        angles_by: (K, M, P).
        tip_by: (K, 2, P).
    """

    angles: Array
    tip: Array
    angles_by: Array
    tip_by: Array


class RodAngles:
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

    def angles(self, values: Array) -> Array:
        """Return predicted bend angles (K, M) [rad] for the unknowns (M, T)."""
        return self._simulate(RodModel(to_limb(self._prior, values), self._nodes)).bend_angles

    def derivatives(self, values: Array, wanted: list[tuple[int, int]]) -> Predicted:
        """Return bend angles and tips with their derivatives by P unknowns.

        Args:
            values: (M, T) unknowns.
            wanted: (segment, term) of each of the P unknowns.

        What acts as a pressure goes through the rod's exact tangent; stiffness, damping and mass,
        which change the rod itself, are differences of two simulations.

        Raises:
            ConvergenceError: the rod cannot follow.
        """
        model = RodModel(to_limb(self._prior, values), self._nodes)
        response = self._simulate(model, linearise=True)
        angles, effective = response.bend_angles, self.effective(values)
        assert response.derivative is not None
        angles_by = np.empty((*angles.shape, len(wanted)))
        tip_by = np.empty((*response.tip.shape, len(wanted)))
        for place, (segment, term) in enumerate(wanted):
            if TERMS[term].group in ("dynamics", "mass"):
                changed = self._difference(values, segment, term, response)
            else:
                change = self._pressure_change(values, segment, term, effective)
                change[:, segment] += self._moment_change(
                    values[segment], term, effective[:, segment], angles[:, segment]
                )
                changed = response.derivative.by_effective(change)
            tip_by[:, :, place], angles_by[:, :, place] = changed
        return Predicted(angles, response.tip, angles_by, tip_by)

    def effective(self, values: Array) -> Array:
        """Return the effective pressures (K, M) [Pa] of the unknowns (M, T)."""
        limb = to_limb(self._prior, values)
        return Material(limb).slow_effective_pressure(self._time, self._pressure)

    def _simulate(self, model: RodModel, linearise: bool = False) -> Response:
        return simulate(
            model, self._time, pressures=self._pressure, steps=SUBSTEPS, linearise=linearise
        )

    def _difference(
        self, values: Array, segment: int, term: int, now: Response
    ) -> tuple[Array, Array]:
        """Return the derivatives of tip and angles by an unknown that changes the rod itself."""
        step = _STEP * TERMS[term].scale
        moved = values.copy()
        put(moved, segment, term, float(values[segment, term]) + step)
        then = self._simulate(RodModel(to_limb(self._prior, moved), self._nodes))
        return (then.tip - now.tip) / step, (then.bend_angles - now.bend_angles) / step

    def _pressure_change(self, values: Array, segment: int, term: int, effective: Array) -> Array:
        """Return ∂(effective pressures)/∂unknown (K, M), by a difference of the closed form."""
        value, kind = float(values[segment, term]), TERMS[term]
        nudge = _NUDGE * kind.scale
        if value + nudge > kind.high:
            nudge = -nudge
        moved = values.copy()
        put(moved, segment, term, value + nudge)
        slope: Array = (self.effective(moved) - effective) / nudge
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
