"""The simulated limb: a PyElastica rod with chambers, fittings, friction and creep."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from elastica import CosseratRod
from numpy.typing import NDArray

from der_planner.twin.hardware import Hardware, draw
from der_planner.twin.kernel import Material, Ramp, RodArrays, advance

Array = NDArray[np.float64]

ATMOSPHERE = 101_325.0
"""Absolute pressure outside the chambers [Pa]."""
TIME_STEP = 2e-4
"""Explicit step [s]; stable for 0.25 ms as well (see the page of the twin)."""
RAMP = 0.02
"""Time in which new chamber pressures reach the limb [s], on a straight line: a jump would ring.
The board tells its pressures once in that time."""
ELEMENTS_PER_SEGMENT = 8
AXIAL_STIFFNESS = 1380.0
"""EA [N] of the silicone tube, which fits its bending stiffness only with a thin wall."""
SHEAR_STIFFNESS = 27.0 / 28.0 * AXIAL_STIFFNESS / 3.0
TORSIONAL_STIFFNESS = 0.0117
RADIUS = 0.0165
"""Outer radius [m]: with 1.066 kg/m it gives the rotary inertia."""
_CHAMBER_LIMIT = 2e5


class TwinError(RuntimeError):
    """The simulated limb was asked for something impossible, or left the range of its physics."""


@dataclass(frozen=True)
class TwinShape:
    """The true centreline at one instant, in `limb_base`.

    Attributes:
        arc_length: (P,) material coordinate from the clamp [m].
        points: (P, 2) x, y [m].
        heading: (P,) direction of the material tangent, from +x toward +y [rad].
    """

    arc_length: Array
    points: Array
    heading: Array


class LimbTwin:
    """A planar two-segment limb that stands in for the hardware.

    Clamped at the origin along +x; the tip is the last node, at material arc length 0.244 m.

    Args:
        seed: draws the hardware; a trial is a seed.
        run: draws how the rest angles wander in this run of the same hardware.
        hardware: takes this hardware instead of drawing it (for tests).
        atmosphere: absolute pressure outside [Pa].
    """

    def __init__(
        self,
        seed: int = 0,
        run: int = 0,
        hardware: Hardware | None = None,
        atmosphere: float = ATMOSPHERE,
    ) -> None:
        self._hardware = draw(seed) if hardware is None else hardware
        self.atmosphere = float(atmosphere)
        self.time = 0.0
        self._carry = 0.0
        self._pressure = np.full(2 * self.segment_count, self.atmosphere)
        self._ramp_left = 0
        self._wander_noise = np.random.default_rng([7_919, seed, run])
        self._build()
        self._wander = np.array([s.wander for s in self._hardware.segments])
        self._wander *= self._wander_noise.standard_normal(self.segment_count)
        self._settle()

    @property
    def segment_count(self) -> int:
        """M, the number of segments."""
        return len(self._hardware.segments)

    @property
    def tip(self) -> Array:
        """(2,) position of the tip [m]."""
        tip: Array = self._rod.position_collection[:2, -1].copy()
        return tip

    @property
    def bend_angles(self) -> Array:
        """(M,) heading at the end of each segment less the heading at its start [rad]."""
        heading = self._element_headings()
        angles: Array = np.diff(heading[self._rigid_elements])
        return angles

    def step(self, chamber_pressure: Array, duration: float) -> None:
        """Advance the limb under constant chamber pressures, which it feels after `RAMP`.

        The explicit step is fixed: a remainder shorter than it is kept for the next call.

        Args:
            chamber_pressure: (2M,) absolute pressures: chambers 0, 1 of segment 0, then of
                segment 1 [Pa].
            duration: [s].

        Raises:
            TwinError: the pressures have another shape, are not finite or above 2 bar gauge.
        """
        target = self._target(chamber_pressure, duration)
        if not np.array_equal(chamber_pressure, self._pressure):
            self._pressure = np.array(chamber_pressure, dtype=float)
            self._ramp_left = round(RAMP / TIME_STEP)
        self._carry += duration
        steps = int(self._carry / TIME_STEP + 1e-9)
        self._carry -= steps * TIME_STEP
        ramp = self._ramp(target, self._ramp_left or steps)
        self._ramp_left = max(0, self._ramp_left - steps)
        advance(self._arrays, self._material, ramp, steps, TIME_STEP, self._hardware.drag)
        self.time += steps * TIME_STEP
        if not np.isfinite(self._rod.position_collection[0, -1]):
            raise TwinError(f"the simulated limb became unstable at t = {self.time:.3f} s")

    def shape(self, points: int = 0) -> TwinShape:
        """Return the true centreline.

        Args:
            points: number of equally spaced points; 0 gives the nodes and the middle of each
                element.

        Returns:
            Interpolated between nodes by cubic Hermite pieces along the material tangents.
        """
        node_arc = self._node_arc
        arc = (
            np.sort(np.concatenate([node_arc, 0.5 * (node_arc[1:] + node_arc[:-1])]))
            if points == 0
            else np.linspace(0.0, node_arc[-1], points)
        )
        heading = self._node_headings()
        nodes = self._rod.position_collection[:2].T
        stretch = np.linalg.norm(np.diff(nodes, axis=0), axis=1) / np.diff(node_arc)
        index = np.clip(np.searchsorted(node_arc, arc, side="right") - 1, 0, len(node_arc) - 2)
        step = (node_arc[1:] - node_arc[:-1])[index]
        u = (arc - node_arc[index]) / step
        tangent = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        scale = (step * stretch[index])[:, None]
        u = u[:, None]
        curve = (
            (1 + 2 * u) * (1 - u) ** 2 * nodes[index]
            + u * (1 - u) ** 2 * scale * tangent[index]
            + u**2 * (3 - 2 * u) * nodes[index + 1]
            + u**2 * (u - 1) * scale * tangent[index + 1]
        )
        return TwinShape(arc, curve, np.interp(arc, node_arc, heading))

    def _target(self, chamber_pressure: Array, duration: float) -> dict[str, Array]:
        """Return what the material shall be under these pressures, by the fields of `Ramp`."""
        pressure = np.asarray(chamber_pressure, dtype=float)
        if pressure.shape != (2 * self.segment_count,):
            raise TwinError(
                f"expected {2 * self.segment_count} chamber pressures, got shape {pressure.shape}"
            )
        gauge = pressure - self.atmosphere
        if not np.all(np.abs(gauge) < _CHAMBER_LIMIT):
            raise TwinError(
                f"chamber pressures must be absolute, in Pa and within 2 bar of the atmosphere "
                f"({self.atmosphere:.0f} Pa): got {pressure}"
            )
        names = ("active", "stiffness", "rest", "rest_stretch")
        target = {name: getattr(self._material, name).copy() for name in names}
        differential = np.concatenate([[0.0], gauge[0::2] - gauge[1::2], [0.0]])
        for index, segment in enumerate(self._hardware.segments):
            neighbours = differential[index] + differential[index + 2]
            crossing = segment.coupling * 0.5 * sum(segment.chamber_gain)
            fade = math.exp(-duration / segment.wander_time)
            kick = segment.wander * math.sqrt(1.0 - fade * fade)
            self._wander[index] = fade * self._wander[index] + kick * float(
                self._wander_noise.standard_normal()
            )
            left, right = gauge[2 * index], gauge[2 * index + 1]
            here = self._vertex_segment == index
            target["active"][here] = (
                segment.chamber_gain[0] * left
                - segment.chamber_gain[1] * right
                + crossing * neighbours
            )
            target["stiffness"][here] = segment.bending_stiffness * (
                1.0 + segment.pressure_stiffening * (left + right)
            )
            target["rest"][here] = segment.rest_curvature + self._wander[index]
            target["rest_stretch"][self._element_segment == index] = segment.elongation * (
                left + right
            )
        return target

    def _ramp(self, target: dict[str, Array], steps: int) -> Ramp:
        each = {
            name: (value - getattr(self._material, name)) / max(steps, 1)
            for name, value in target.items()
        }
        return Ramp(steps=steps, **each)

    def _settle(self) -> None:
        rest = np.full(2 * self.segment_count, self.atmosphere)
        steps = int(2.0 / TIME_STEP)
        ramp = self._ramp(self._target(rest, 0.0), steps // 4)
        advance(self._arrays, self._material, ramp, steps, TIME_STEP, 8.0)
        self._rod.velocity_collection[:] = 0.0
        self._rod.omega_collection[:] = 0.0
        self._material.creep[:] = 0.0

    def _element_headings(self) -> Array:
        tangent = self._rod.director_collection[2]
        heading: Array = np.unwrap(np.arctan2(tangent[1], tangent[0]))
        return heading

    def _node_headings(self) -> Array:
        element = self._element_headings()
        # Between a stiff and a flexible element the bend belongs to the flexible half.
        flexible = np.where(self._element_segment >= 0, self._rod.rest_lengths, 0.0)
        weight = flexible[1:] / np.maximum(flexible[1:] + flexible[:-1], 1e-12)
        inner = element[:-1] + (1.0 - weight) * np.diff(element)
        return np.concatenate([element[:1], inner, element[-1:]])

    def _build(self) -> None:
        hardware, count = self._hardware, ELEMENTS_PER_SEGMENT
        lengths = [hardware.base_fitting]
        owner = [-1]
        for index, segment in enumerate(hardware.segments):
            lengths += [segment.flexible_length / count] * count
            owner += [index] * count
            last = index == self.segment_count - 1
            lengths.append(hardware.tip_fitting if last else hardware.connector)
            owner.append(-1)
        rest_lengths = np.array(lengths)
        self._element_segment = np.array(owner)
        self._rigid_elements = np.nonzero(self._element_segment < 0)[0]
        self._node_arc = np.concatenate([[0.0], np.cumsum(rest_lengths)])
        position = np.zeros((3, len(lengths) + 1))
        position[0] = self._node_arc
        density = hardware.mass_per_length / (math.pi * RADIUS**2)
        rod = CosseratRod.straight_rod(
            len(lengths),
            np.zeros(3),
            np.array([1.0, 0.0, 0.0]),
            np.array([0.0, 0.0, 1.0]),
            self._node_arc[-1],
            RADIUS,
            density,
            youngs_modulus=AXIAL_STIFFNESS / (math.pi * RADIUS**2),
            position=position,
        )
        self._rod = rod
        self._set_sections(rest_lengths)
        self._set_fittings()
        self._set_material(rest_lengths)
        self._collect()

    def _set_sections(self, rest_lengths: Array) -> None:
        rod = self._rod
        flexible = rest_lengths[self._element_segment == 0][0]
        for k in range(rod.n_elems):
            # A short stiff fitting would shorten the step for nothing: it gives like a whole
            # element.
            share = 1.0 if self._element_segment[k] >= 0 else rest_lengths[k] / flexible
            rod.shear_matrix[0, 0, k] = rod.shear_matrix[1, 1, k] = SHEAR_STIFFNESS * share
            rod.shear_matrix[2, 2, k] = AXIAL_STIFFNESS * share
        stiffness = max(segment.bending_stiffness for segment in self._hardware.segments)
        for i, value in enumerate((stiffness, stiffness, TORSIONAL_STIFFNESS)):
            rod.bend_matrix[i, i, :] = value

    def _set_fittings(self) -> None:
        rod, hardware = self._rod, self._hardware
        masses = [0.0, hardware.connector_mass, hardware.tip_mass]
        for element, mass in zip(self._rigid_elements, masses, strict=True):
            rod.mass[element : element + 2] += 0.5 * mass
            for i, factor in enumerate((0.25, 0.25, 0.5)):
                rod.mass_second_moment_of_inertia[i, i, element] += factor * mass * RADIUS**2
                rod.inv_mass_second_moment_of_inertia[i, i, element] = (
                    1.0 / rod.mass_second_moment_of_inertia[i, i, element]
                )

    def _set_material(self, rest_lengths: Array) -> None:
        owner = self._element_segment
        self._vertex_segment = np.maximum(owner[1:], owner[:-1])
        flexible = np.where(owner >= 0, rest_lengths, 0.0)
        share = (flexible[1:] + flexible[:-1]) / (rest_lengths[1:] + rest_lengths[:-1])
        per_vertex = [self._hardware.segments[index] for index in self._vertex_segment]

        def column(name: str) -> Array:
            return np.array([getattr(segment, name) for segment in per_vertex], dtype=float)

        count = len(per_vertex)
        self._material = Material(
            flexible_share=share,
            stiffness=column("bending_stiffness"),
            cubic=column("cubic_stiffness"),
            rest=column("rest_curvature"),
            active=np.zeros(count),
            friction_moment=column("friction_moment"),
            friction_curvature=column("friction_curvature"),
            friction_exponent=column("friction_exponent"),
            friction_share=column("friction_share"),
            creep_stiffness=np.ascontiguousarray(column("creep_stiffness").T),
            creep_time=np.ascontiguousarray(column("creep_time").T),
            curvature=np.zeros(count),
            friction=np.zeros(count),
            creep=np.zeros((3, count)),
            rest_stretch=np.zeros(len(owner)),
        )

    def _collect(self) -> None:
        rod = self._rod
        self._arrays = RodArrays(
            position=rod.position_collection,
            velocity=rod.velocity_collection,
            directors=rod.director_collection,
            omega=rod.omega_collection,
            acceleration=rod.acceleration_collection,
            alpha=rod.alpha_collection,
            volume=rod.volume,
            lengths=rod.lengths,
            tangents=rod.tangents,
            radius=rod.radius,
            rest_lengths=rod.rest_lengths,
            rest_voronoi_lengths=rod.rest_voronoi_lengths,
            dilatation=rod.dilatation,
            dilatation_rate=rod.dilatation_rate,
            voronoi_dilatation=rod.voronoi_dilatation,
            sigma=rod.sigma,
            rest_sigma=rod.rest_sigma,
            kappa=rod.kappa,
            rest_kappa=rod.rest_kappa,
            shear_matrix=rod.shear_matrix,
            bend_matrix=rod.bend_matrix,
            internal_stress=rod.internal_stress,
            internal_couple=rod.internal_couple,
            internal_forces=rod.internal_forces,
            internal_torques=rod.internal_torques,
            external_forces=rod.external_forces,
            external_torques=rod.external_torques,
            mass=rod.mass,
            inertia=rod.mass_second_moment_of_inertia,
            inverse_inertia=rod.inv_mass_second_moment_of_inertia,
            ghost_elements=rod.ghost_elems_idx,
            ghost_vertices=rod.ghost_voronoi_idx,
        )
