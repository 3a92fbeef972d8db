"""The simulated limb as PyElastica's rod: mesh, sections, fittings, material, and its loads."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from elastica import CosseratRod
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.limb import BEYOND_THE_TIP, GRAVITY
from der_planner.twin.hardware import DrawnHardware
from der_planner.twin.kernel import RodArrays, SectionMaterial

ELEMENTS_PER_SEGMENT = 8
AXIAL_STIFFNESS = 1380.0
"""EA [N] of the silicone tube, which fits its bending stiffness only with a thin wall."""
SHEAR_STIFFNESS = 27.0 / 28.0 * AXIAL_STIFFNESS / 3.0
TORSIONAL_STIFFNESS = 0.0117
RADIUS = 0.0165
"""Outer radius [m]: with 1.066 kg/m it gives the rotary inertia."""
_ITS_NAMES = {
    "position": "position_collection",
    "velocity": "velocity_collection",
    "directors": "director_collection",
    "omega": "omega_collection",
    "acceleration": "acceleration_collection",
    "alpha": "alpha_collection",
    "inertia": "mass_second_moment_of_inertia",
    "inverse_inertia": "inv_mass_second_moment_of_inertia",
    "ghost_elements": "ghost_elems_idx",
    "ghost_vertices": "ghost_voronoi_idx",
}
"""PyElastica's names of those `RodArrays` that it calls otherwise."""


@dataclass(frozen=True)
class LimbBody:
    """A limb of M segments at rest along +x, clamped at the origin.

    Attributes:
        rod: PyElastica's rod of E elements.
        arrays: of the rod, as the kernel takes them.
        material: the bending law at each vertex.
        node_arc: (E+1,) material coordinate of the nodes [m].
        element_segment: (E,) segment of each element; -1 for a stiff fitting.
        vertex_segment: (E-1,) segment whose material bends at each vertex.
    """

    rod: CosseratRod
    arrays: RodArrays
    material: SectionMaterial
    node_arc: Array
    element_segment: NDArray[np.int64]
    vertex_segment: NDArray[np.int64]


def build(hardware: DrawnHardware) -> LimbBody:
    """Return the rod of a limb, straight and unloaded."""
    lengths, owner = [hardware.base_fitting], [-1]
    for index, segment in enumerate(hardware.segments):
        lengths += [segment.flexible_length / ELEMENTS_PER_SEGMENT] * ELEMENTS_PER_SEGMENT
        owner += [index] * ELEMENTS_PER_SEGMENT
        last = index == len(hardware.segments) - 1
        lengths.append(hardware.tip_fitting if last else hardware.connector)
        owner.append(-1)
    rest_lengths, element_segment = np.array(lengths), np.array(owner)
    node_arc = np.concatenate([[0.0], np.cumsum(rest_lengths)])
    position = np.zeros((3, len(lengths) + 1))
    position[0] = node_arc
    rod = CosseratRod.straight_rod(
        len(lengths),
        np.zeros(3),
        np.array([1.0, 0.0, 0.0]),
        np.array([0.0, 0.0, 1.0]),
        node_arc[-1],
        RADIUS,
        hardware.mass_per_length / (math.pi * RADIUS**2),
        youngs_modulus=AXIAL_STIFFNESS / (math.pi * RADIUS**2),
        position=position,
    )
    vertex_segment = np.maximum(element_segment[1:], element_segment[:-1])
    flexible = np.where(element_segment >= 0, rest_lengths, 0.0)
    share = (flexible[1:] + flexible[:-1]) / (rest_lengths[1:] + rest_lengths[:-1])
    _set_sections(rod, hardware, element_segment)
    # What the law of the plane does for itself: only the flexible share of a vertex bends.
    rod.bend_matrix[1, 1, :] /= share
    _set_fittings(rod, hardware, np.nonzero(element_segment < 0)[0])
    return LimbBody(
        rod=rod,
        arrays=_arrays(rod),
        material=_material(hardware, vertex_segment, share, len(lengths)),
        node_arc=node_arc,
        element_segment=element_segment,
        vertex_segment=vertex_segment,
    )


def _set_sections(
    rod: CosseratRod, hardware: DrawnHardware, element_segment: NDArray[np.int64]
) -> None:
    # A short stiff fitting would shorten the step for nothing: it gives like a whole element.
    flexible = rod.rest_lengths[element_segment == 0][0]
    share = np.where(element_segment >= 0, 1.0, rod.rest_lengths / flexible)
    for i, value in enumerate((SHEAR_STIFFNESS, SHEAR_STIFFNESS, AXIAL_STIFFNESS)):
        rod.shear_matrix[i, i, :] = value * share
    stiffness = max(segment.bending_stiffness for segment in hardware.segments)
    for i, value in enumerate((stiffness, stiffness, TORSIONAL_STIFFNESS)):
        rod.bend_matrix[i, i, :] = value


def _set_fittings(
    rod: CosseratRod, hardware: DrawnHardware, rigid_elements: NDArray[np.int64]
) -> None:
    masses = [0.0, hardware.connector_mass, hardware.tip_mass]
    for element, mass in zip(rigid_elements, masses, strict=True):
        rod.mass[element : element + 2] += 0.5 * mass
        inertia = rod.mass_second_moment_of_inertia[:, :, element]
        inertia += mass * RADIUS**2 * np.diag([0.25, 0.25, 0.5])
        rod.inv_mass_second_moment_of_inertia[:, :, element] = np.diag(1.0 / np.diag(inertia))


def _material(
    hardware: DrawnHardware, vertex_segment: NDArray[np.int64], share: Array, elements: int
) -> SectionMaterial:
    per_vertex = [hardware.segments[index] for index in vertex_segment]

    def column(name: str) -> Array:
        values = np.array([getattr(segment, name) for segment in per_vertex], dtype=float)
        return np.ascontiguousarray(values.T)

    count = len(per_vertex)
    return SectionMaterial(
        flexible_share=share,
        stiffness=column("bending_stiffness"),
        cubic=column("cubic_stiffness"),
        rest=column("rest_curvature"),
        active=np.zeros(count),
        friction_moment=column("friction_moment"),
        friction_curvature=column("friction_curvature"),
        friction_exponent=column("friction_exponent"),
        friction_share=column("friction_share"),
        creep_stiffness=column("creep_stiffness"),
        creep_time=column("creep_time"),
        curvature=np.zeros(count),
        friction=np.zeros(count),
        creep=np.zeros((3, count)),
        rest_stretch=np.zeros(elements),
    )


def _arrays(rod: CosseratRod) -> RodArrays:
    return RodArrays(*(getattr(rod, _ITS_NAMES.get(name, name)) for name in RodArrays._fields))


class TwinError(RuntimeError):
    """The simulated limb was asked for something impossible, or left the range of its physics."""


STRONGEST_PUSH = 10.0
"""Force of the strongest push, over the limb's weight: beyond it the rod's steps are too long."""


@dataclass(frozen=True)
class Push:
    """A force on the limb, or a mass that is hung on it, for a while.

    Attributes:
        instant: from when on [s]; of which clock, says who takes it.
        arc_length: where, from the clamp [m].
        force: (3,) in `limb_base` [N]; its direction stays the same while the limb moves.
        mass: that hangs there meanwhile [kg]; negative for one that is taken off.
        duration: how long [s].
    """

    instant: float
    arc_length: float
    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mass: float = 0.0
    duration: float = math.inf

    @property
    def end(self) -> float:
        """When it ends [s]."""
        return self.instant + self.duration if math.isfinite(self.duration) else math.inf

    def acts(self, time: float) -> bool:
        """Whether it acts at this time [s]."""
        return self.instant <= time < self.end


class NodeLoads:
    """The loads of a rod as masses and forces of its nodes.

    A load between two nodes is shared between them by the lever rule: the sum and the first
    moment are exact, and gravity does the work on the nodes that it does on the load.

    Args:
        node_arc: (E+1,) material coordinate of the nodes [m].
        mass: (E+1,) of the nodes [kg]; kept up to date in place.
        force: (3, E+1) external forces [N]; kept up to date in place.
        gravity: (3,) acceleration in `limb_base` [m/s²].

    Raises:
        TwinError: gravity is not three finite numbers.
    """

    def __init__(
        self, node_arc: Array, mass: Array, force: Array, gravity: Sequence[float]
    ) -> None:
        if len(gravity) != 3 or not np.all(np.isfinite(gravity)):
            raise TwinError(f"gravity must be three finite numbers in m/s², got {gravity}")
        self._node_arc = node_arc
        self._own_mass = mass.copy()
        self._mass = mass
        self._force = force
        self._gravity = np.array(gravity, dtype=float)
        self._pushes: list[tuple[Push, Array]] = []
        self.update(0.0)

    @property
    def any(self) -> bool:
        """Whether a force acts."""
        return bool(np.any(self._force))

    def add(self, push: Push) -> None:
        """Take a push into the schedule; `update` puts it on the nodes when it is time.

        Raises:
            TwinError: the place is not on the limb, a number is not finite, more mass is taken off
                than there is, or the push is too strong for the limb.
        """
        if not np.all(np.isfinite([*push.force, push.mass])) or len(push.force) != 3:
            raise TwinError(f"force and mass of a push must be finite, got {push}")
        weight, pull = GRAVITY * float(self._own_mass.sum()), GRAVITY * max(0.0, push.mass)
        if np.linalg.norm(push.force) + pull > STRONGEST_PUSH * weight:
            raise TwinError(
                f"a push is more than {STRONGEST_PUSH:.0f} times the limb's weight of "
                f"{weight:.2g} N: give N and kg, got {push}"
            )
        if math.isnan(push.instant) or not push.duration > 0:
            raise TwinError(f"a push needs an instant and a duration above 0 s, got {push}")
        hung = [*self._pushes, (push, self._shares(push.arc_length))]
        if np.any(self._own_mass + sum(each.mass * borne for each, borne in hung) <= 0.0):
            raise TwinError(f"there is no mass of {-push.mass} kg at {push.arc_length} m to take")
        self._pushes = hung

    def next_change(self, time: float) -> float:
        """Return when the next push begins or ends after a time [s]; infinite for never."""
        instants = [
            instant
            for push, _ in self._pushes
            for instant in (push.instant, push.end)
            if instant > time
        ]
        return min(instants, default=math.inf)

    def update(self, time: float) -> None:
        """Put what acts at a time [s] on the nodes."""
        self._pushes = [each for each in self._pushes if each[0].end > time]
        acting = [(push, shares) for push, shares in self._pushes if push.acts(time)]
        self._mass[:] = self._own_mass
        for push, shares in acting:
            self._mass += push.mass * shares
        self._force[:] = self._gravity[:, None] * self._mass
        for push, shares in acting:
            self._force += np.array(push.force)[:, None] * shares

    def _shares(self, arc_length: float) -> Array:
        """Return what each node (E+1,) bears of a load at an arc length [m]."""
        end = float(self._node_arc[-1])
        if not -1e-9 <= arc_length <= end + BEYOND_THE_TIP:
            raise TwinError(
                f"a load at {arc_length} m is not on the limb: its arc length is 0 to {end:.3f} m"
            )
        own = np.eye(len(self._node_arc))
        return np.array([np.interp(arc_length, self._node_arc, node) for node in own])
