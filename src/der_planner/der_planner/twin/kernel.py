"""The time loop of the simulated limb, compiled around PyElastica's own kernels.

PyElastica's module system calls Python code several times a step, which costs more than the
physics of a rod of twenty elements. Here its kinematic update, its internal forces and torques
and its accelerations are called in the order of its position Verlet stepper, from one compiled
loop. What the limb adds - chambers, friction, creep - enters as the constitutive law of
PyElastica's bending couple.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from elastica._calculus import difference_kernel_for_block_structure
from elastica._contact_functions import _calculate_contact_forces_rod_sphere
from elastica._linalg import _batch_matvec
from elastica.rod.cosserat_rod import (
    _compute_bending_twist_strains,
    _compute_internal_torques,
    _compute_shear_stretch_strains,
    _update_accelerations,
)
from elastica.rod.data_structures import overload_operator_kinematic_numba
from numba import njit
from numpy.typing import NDArray

import der_planner.rod.compile  # noqa: F401 - drops caches that are older than this source
from der_planner.arrays import Array

CONTACT_STIFFNESS = 1e4
"""Of a peg [N/m]: 1 N presses the limb 0.1 mm into it."""
CONTACT_DAMPING = 5.0
"""Of a peg [N·s/m]."""
VISCOUS_TIME = 1e-4
"""τ of the material's own damping [s], a loss factor ω τ of 0.02 at the lowest axial mode (37 Hz)
and of 0.4 at the mesh's highest. Without it these modes would ring on, reverse the bend all the
time, and so keep the friction far below its full moment."""


class RodArrays(NamedTuple):
    """The arrays of a PyElastica `CosseratRod` that its kernels read and write, by its names."""

    position: Array
    velocity: Array
    directors: Array
    omega: Array
    acceleration: Array
    alpha: Array
    volume: Array
    lengths: Array
    tangents: Array
    radius: Array
    rest_lengths: Array
    rest_voronoi_lengths: Array
    dilatation: Array
    dilatation_rate: Array
    voronoi_dilatation: Array
    sigma: Array
    rest_sigma: Array
    kappa: Array
    rest_kappa: Array
    shear_matrix: Array
    bend_matrix: Array
    internal_stress: Array
    internal_couple: Array
    internal_forces: Array
    internal_torques: Array
    external_forces: Array
    external_torques: Array
    mass: Array
    inertia: Array
    inverse_inertia: Array
    ghost_elements: NDArray[np.int32]
    ghost_vertices: NDArray[np.int32]


class SectionMaterial(NamedTuple):
    """The bending law at each vertex (K,): parameters, then the state that it remembers.

    moment = stiffness (κ − rest + τ κ̇) + cubic (κ − rest)³ + friction_moment z +
    Σ creep_stiffness q − active

    and at each element (E,) the strain at which its stretch is at rest.
    """

    flexible_share: Array  # flexible length at a vertex over its Voronoi length
    stiffness: Array  # [N·m²]
    cubic: Array  # [N·m⁴]
    rest: Array  # [1/m]
    active: Array  # [N·m] moment of the chambers
    friction_moment: Array  # [N·m]
    friction_curvature: Array  # [1/m]
    friction_exponent: Array
    friction_share: Array
    creep_stiffness: Array  # (3, K) [N·m²]
    creep_time: Array  # (3, K) [s]
    curvature: Array  # state: κ at the last step [1/m]
    friction: Array  # state: z in −1 … 1
    creep: Array  # state: q (3, K) [1/m]
    rest_stretch: Array  # (E,) strain at rest [-]


class Pegs(NamedTuple):
    """Round things that stand in the plane of the limb and do not move."""

    centre: Array  # (P, 3) [m]
    radius: Array  # (P,) [m]
    force: Array  # (P, 3, 1) by which the limb presses on each, at the last step [N]


class Ramp(NamedTuple):
    """What the chambers change in each of the next steps, until they hold their new pressure."""

    steps: int
    active: Array  # (K,) [N·m] a step
    stiffness: Array  # (K,) [N·m²] a step
    rest: Array  # (K,) [1/m] a step
    rest_stretch: Array  # (E,) a step


@njit(cache=True)
def bending_law(material: SectionMaterial, kappa: Array, couple: Array, dt: float) -> None:
    """Write the planar bending moment of each vertex (K,) [N·m] and advance what it remembers.

    Friction is a Bouc-Wen element, κ_f dz = (1 − |z|ⁿ (β sgn(z dκ) + 1 − β)) dκ, kept within ±1,
    and creep a Maxwell element, q̇ = κ̇ − q/τ, integrated exactly for a constant rate, so that any
    rate of bending is stable.
    """
    for k in range(kappa.shape[0]):
        curvature = kappa[k] / material.flexible_share[k]
        change = curvature - material.curvature[k]
        material.curvature[k] = curvature
        z = material.friction[k]
        share = material.friction_share[k]
        loading = share if z * change >= 0.0 else -share
        decay = abs(z) ** material.friction_exponent[k] * (loading + 1.0 - share)
        z += change / material.friction_curvature[k] * (1.0 - decay)
        material.friction[k] = min(1.0, max(-1.0, z))
        strain = curvature - material.rest[k]
        moment = (
            material.stiffness[k] * (strain + VISCOUS_TIME * change / dt)
            + material.cubic[k] * strain**3
            + material.friction_moment[k] * material.friction[k]
            - material.active[k]
        )
        for branch in range(3):
            rate = dt / material.creep_time[branch, k]
            keep = np.exp(-rate)
            material.creep[branch, k] = (
                material.creep[branch, k] * keep + change * (1.0 - keep) / rate
            )
            moment += material.creep_stiffness[branch, k] * material.creep[branch, k]
        couple[k] = moment


@njit(cache=True)
def advance(
    rod: RodArrays,
    material: SectionMaterial,
    ramp: Ramp,
    pegs: Pegs,
    steps: int,
    dt: float,
    drag: float,
) -> None:
    """Advance the limb by ``steps`` position Verlet steps of ``dt`` [s].

    Args:
        rod: changed in place; its first element is clamped.
        material: changed in place.
        ramp: how the material changes with the pressures from the first step on.
        pegs: in the way; their forces are changed in place.
        steps: number of steps.
        dt: [s] below the stability limit of the stiffest mode.
        drag: mass-proportional damping [1/s], integrated exactly.
    """
    keep = np.exp(-drag * dt)
    vertices = rod.kappa.shape[1]
    moment = np.zeros(vertices)
    strain, loads = rod.sigma.copy(), rod.external_forces.copy()
    for step in range(steps):
        if step < ramp.steps:
            material.active[:] += ramp.active
            material.stiffness[:] += ramp.stiffness
            material.rest[:] += ramp.rest
            material.rest_stretch[:] += ramp.rest_stretch
        overload_operator_kinematic_numba(
            0.5 * dt, rod.position, rod.directors, rod.velocity, rod.omega
        )
        _compute_bending_twist_strains(rod.directors, rod.rest_voronoi_lengths, rod.kappa)
        bending_law(material, rod.kappa[0], moment, dt)
        for k in range(vertices):
            # PyElastica's couple is B (κ − κ_rest): this rest curvature makes it the law's moment.
            rod.rest_kappa[0, k] = rod.kappa[0, k] - moment[k] / rod.bend_matrix[0, 0, k]
        _internal_forces(rod, material, strain, dt)
        _press(rod, pegs)
        _accelerations(rod)
        rod.external_forces[:] = loads
        _kick(rod, dt, keep)
        overload_operator_kinematic_numba(
            0.5 * dt, rod.position, rod.directors, rod.velocity, rod.omega
        )


@njit(cache=True)
def _press(rod: RodArrays, pegs: Pegs) -> None:
    """Add what pegs press on the limb to its external forces, by PyElastica's contact, smooth."""
    still, edges = np.zeros((3, 1)), rod.tangents * rod.lengths
    first = np.ascontiguousarray(rod.position[:, :-1])
    for p in range(len(pegs.radius)):
        pegs.force[p] = 0.0
        _calculate_contact_forces_rod_sphere(
            first,
            edges,
            pegs.centre[p],
            rod.radius + pegs.radius[p],
            rod.lengths + rod.radius,
            rod.external_forces,
            pegs.force[p],
            rod.velocity,
            still,
            CONTACT_STIFFNESS,
            CONTACT_DAMPING,
            0.0,
            0.0,
        )


@njit(cache=True)
def _internal_forces(rod: RodArrays, material: SectionMaterial, before: Array, dt: float) -> None:
    """Fill the stress S (σ − rest + τ σ̇) (3, E) [N] and the internal forces (3, E+1) [N].

    The same as PyElastica's kernel, which has no σ̇, with the strains computed once.

    Args:
        rod: changed in place.
        material: tells the strain at rest.
        before: (3, E) σ at the last step, becomes σ now.
        dt: [s] since then.
    """
    _compute_shear_stretch_strains(
        rod.position,
        rod.volume,
        rod.lengths,
        rod.tangents,
        rod.radius,
        rod.rest_lengths,
        rod.rest_voronoi_lengths,
        rod.dilatation,
        rod.voronoi_dilatation,
        rod.directors,
        rod.sigma,
    )
    rod.rest_sigma[:] = VISCOUS_TIME * (before - rod.sigma) / dt
    rod.rest_sigma[2, :] += material.rest_stretch
    before[:] = rod.sigma
    rod.internal_stress[:] = _batch_matvec(rod.shear_matrix, rod.sigma - rod.rest_sigma)
    world = np.zeros_like(rod.internal_stress)
    for i in range(3):
        for j in range(3):
            for k in range(world.shape[1]):
                world[i, k] += rod.directors[j, i, k] * rod.internal_stress[j, k]
    world /= rod.dilatation
    rod.internal_forces[:] = difference_kernel_for_block_structure(world, rod.ghost_elements)


@njit(cache=True)
def _accelerations(rod: RodArrays) -> None:
    """Fill the internal torques from the stress, and both accelerations."""
    _compute_internal_torques(
        rod.position,
        rod.velocity,
        rod.tangents,
        rod.lengths,
        rod.rest_lengths,
        rod.directors,
        rod.rest_voronoi_lengths,
        rod.bend_matrix,
        rod.rest_kappa,
        rod.kappa,
        rod.voronoi_dilatation,
        rod.inertia,
        rod.omega,
        rod.internal_stress,
        rod.internal_couple,
        rod.dilatation,
        rod.dilatation_rate,
        rod.internal_torques,
        rod.ghost_vertices,
    )
    _update_accelerations(
        rod.acceleration,
        rod.internal_forces,
        rod.external_forces,
        rod.mass,
        rod.alpha,
        rod.inverse_inertia,
        rod.internal_torques,
        rod.external_torques,
        rod.dilatation,
    )


@njit(cache=True)
def _kick(rod: RodArrays, dt: float, keep: float) -> None:
    for i in range(3):
        for k in range(2, rod.velocity.shape[1]):
            rod.velocity[i, k] = (rod.velocity[i, k] + dt * rod.acceleration[i, k]) * keep
        for k in range(1, rod.omega.shape[1]):
            rod.omega[i, k] = (rod.omega[i, k] + dt * rod.alpha[i, k]) * keep
