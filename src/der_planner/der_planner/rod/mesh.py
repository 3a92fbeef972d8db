"""The numbers of a discrete rod, and how they follow from a uniform rod or from a limb."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.arrays import Array
from der_planner.limb import Limb


@dataclass(frozen=True)
class Mesh:
    """Every number of a discrete rod of N nodes along x, in SI units.

    Attributes:
        rest: (N-1,) edge lengths at rest.
        axial: (N-1,) EA of each edge.
        edge_mass: (N-1,) mass of each edge, which weighs and is damped.
        swung_mass: (N-1,) mass with which each edge resists acceleration.
        edge_inertia: (N-1,) moment of inertia of each edge about its tangent.
        edge_damping: (N-1,) mass-proportional damping rate.
        bend: (N,) EI / l of each node (0 where the rod does not bend, as at a free end).
        twist: (N,) GJ / l of each node.
        cubic: (N,) k3 / l³ of each node.
        viscous: (N,) EI τ / l of each node.
        rest_kappa: (N, 2) integrated curvature at rest toward +y and +z.
        rest_twist: (N,) twist at rest.
        gravity: (3,).
        ghost: whether a ghost edge behind node 0 clamps the rod.
        clamped: indices into q that do not move.
        segments: ((first node, node count), …).
        gain: (M,) Λ [N/Pa].
        point_mass: (N,) carried by each node beside its edges' halves; it is not damped.
        base: x of node 0.
    """

    rest: Array
    axial: Array
    edge_mass: Array
    swung_mass: Array
    edge_inertia: Array
    edge_damping: Array
    bend: Array
    twist: Array
    cubic: Array
    viscous: Array
    rest_kappa: Array
    rest_twist: Array
    gravity: Array
    ghost: bool
    clamped: NDArray[np.int64]
    segments: tuple[tuple[int, int], ...]
    gain: Array
    point_mass: Array
    base: float = 0.0

    @property
    def nodes(self) -> int:
        """N."""
        return len(self.rest) + 1

    @property
    def mass_diagonal(self) -> Array:
        """(4N-1,) M."""
        return interleave(self.swung_node_mass[:, None], self.edge_inertia)

    @property
    def damping_diagonal(self) -> Array:
        """(4N-1,) D of the mass-proportional damping."""
        return interleave(self.node_damping[:, None], self.edge_inertia * self.edge_damping)

    @property
    def weight(self) -> Array:
        """(4N-1,) gravity on the nodes [N]."""
        return interleave(np.outer(self.node_mass, self.gravity), 0.0)

    @property
    def node_mass(self) -> Array:
        """(N,) half the mass of the edges at each node, and what it carries: what weighs."""
        return _on_nodes(self.edge_mass) + self.point_mass

    @property
    def swung_node_mass(self) -> Array:
        """(N,) the same of what resists acceleration."""
        return _on_nodes(self.swung_mass) + self.point_mass

    @property
    def node_damping(self) -> Array:
        """(N,) damping coefficient of each node [kg/s]."""
        return _on_nodes(self.edge_mass * self.edge_damping)


def _on_nodes(of_edges: Array) -> Array:
    """Return (N,) half of what the edges (N-1,) at each node have."""
    half = 0.5 * of_edges
    total: Array = np.append(half, 0.0) + np.append(0.0, half)
    return total


def interleave(of_nodes: Array, of_edges: Array | float) -> Array:
    """Return (4N-1,) with values of nodes (N, 3 or 1) at positions, of edges (N-1,) at angles."""
    rows = np.zeros((len(of_nodes), 4))
    rows[:, :3] = of_nodes
    rows[:-1, 3] = of_edges
    result: Array = rows.ravel()[:-1]
    return result


def require(condition: bool, name: str, expected: str, got: object) -> None:
    """Raise a ValueError that says what was expected of `name` and what came."""
    if not condition:
        raise ValueError(f"{name} must be {expected}, got {got!r}")


def positive(value: float, name: str) -> float:
    """Return a positive finite number or raise a ValueError."""
    require(math.isfinite(value) and value > 0, name, "a positive number", value)
    return float(value)


def not_negative(value: float, name: str) -> float:
    """Return a finite number of 0 or more or raise a ValueError."""
    require(math.isfinite(value) and value >= 0, name, "0 or more", value)
    return float(value)


def array(value: ArrayLike, shape: tuple[int, ...], name: str) -> Array:
    """Return a finite C-contiguous array of the given shape or raise a ValueError."""
    try:
        result = np.ascontiguousarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be numbers of shape {shape}: {error}") from error
    if result.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {result.shape}")
    if not np.isfinite(result).all():
        raise ValueError(
            f"{name} must be finite, got {int((~np.isfinite(result)).sum())} that are not"
        )
    return result


def by_step(pressures: ArrayLike, substeps: int, segment_count: int) -> Array:
    """Return pressures (K, M) or (K, substeps, M) as (K, substeps, M).

    Raises:
        ValueError: another shape, a value that is not finite, or no positive number of substeps.
    """
    require(isinstance(substeps, (int, np.integer)) and substeps > 0, "substeps",
            "an int of 1 or more", substeps)  # fmt: skip
    given = np.asarray(pressures, dtype=np.float64)
    require(given.ndim in (2, 3), "pressures", "(K, M) or (K, substeps, M)", given.shape)
    intervals = given.shape[0]
    if given.ndim == 2:
        array(given, (intervals, segment_count), "pressures")
        given = np.repeat(given[:, None, :], substeps, axis=1)
    return array(given, (intervals, substeps, segment_count), "pressures")


def check_segments(segments: Sequence[tuple[int, int]], nodes: int) -> tuple[tuple[int, int], ...]:
    """Return the segments; raise a ValueError if they leave the rod or share a node."""
    last = -1
    for index, (first, count) in enumerate(segments):
        name = f"segments[{index}]"
        require(count >= 3, name, "at least 3 nodes long (two edges)", (first, count))
        require(first > last, name, f"after node {last}, sharing no node", (first, count))
        last = first + count - 1
        require(last < nodes, name, f"within {nodes} nodes", (first, count))
    return tuple((int(first), int(count)) for first, count in segments)


def clamped_indices(clamp: str, fixed: Sequence[int], nodes: int) -> NDArray[np.int64]:
    """Return the sorted indices into q that a clamp and a user's choice hold."""
    held = {"ghost": range(3), "inside": range(7), "free": range(0)}
    require(clamp in held, "clamp", "'ghost', 'inside' or 'free'", clamp)
    size = 4 * nodes - 1
    require(all(0 <= d < size for d in fixed), "fixed", f"indices in 0 … {size - 1}", list(fixed))
    return np.array(sorted({*held[clamp], *map(int, fixed)}), dtype=np.int64)


def masses_on_nodes(masses: Sequence[tuple[float, float]], rest: Array) -> Array:
    """Return the (N,) nodes' shares of masses (arc length from node 0 [m], mass [kg]).

    A mass between two nodes is split between them by the lever: its sum and its first moment stay.
    """
    ends = np.append(0.0, np.cumsum(rest))
    result = np.zeros(len(ends))
    for index, (place, mass) in enumerate(masses):
        not_negative(mass, f"masses[{index}] [kg]")
        inside = -1e-9 * ends[-1] <= place <= ends[-1] * (1 + 1e-9)
        require(inside, f"masses[{index}] at", f"within 0 … {ends[-1]:.6g} m", place)
        result += [mass * np.interp(place, ends, node) for node in np.eye(len(ends))]
    return result


def limb_mesh(limb: Limb, nodes: int) -> Mesh:
    """Return the mesh of `Rod.from_limb`; see there for the arguments."""
    least = 3 * limb.segment_count
    require(isinstance(nodes, (int, np.integer)) and nodes >= least, "nodes",
            f"an int of {least} or more for {limb.segment_count} segments", nodes)  # fmt: skip
    owner, rest, pairs = _segment_edges(limb, nodes)
    # What bends at a node is half of each edge beside it; a rigid connector does not bend.
    half = np.where((owner < 0) & (limb.connector_length > 0.0), 0.0, 0.5 * rest)
    before, after = np.append(0.0, half), np.append(half, 0.0)
    before[-1] = after[-1] = 0.0
    # The segments behind and ahead of each edge: the same one unless it is a connector.
    behind, ahead = (np.where(owner < 0, np.roll(owner, by), owner) for by in (1, -1))

    def of_edges(name: str) -> Array:
        values = np.array([getattr(segment, name) for segment in limb.segments])
        mean: Array = 0.5 * (values[behind] + values[ahead])
        return mean

    def of_nodes(name: str) -> tuple[Array, Array]:
        values = of_edges(name)
        return np.append(values[0], values), np.append(values, values[-1])

    def compliance(name: str) -> Array:
        left, right = of_nodes(name)
        total = before / left + after / right
        return np.divide(1.0, total, out=np.zeros(nodes), where=total > 0)

    cell = before + after
    bend = compliance("bending_stiffness")
    edge_mass = of_edges("mass_per_length") * rest
    polar = 2.0 * of_edges("bending_stiffness") / of_edges("axial_stiffness")
    cubic = np.zeros(nodes)
    np.divide(np.minimum(*of_nodes("cubic_stiffness")), cell**3, out=cubic, where=cell > 0)
    gain, rest_kappa = _actuation(limb, rest, pairs, cubic)
    return Mesh(
        rest=rest,
        axial=of_edges("axial_stiffness"),
        edge_mass=edge_mass,
        swung_mass=edge_mass * of_edges("swing_inertia"),
        edge_inertia=edge_mass * polar,
        edge_damping=of_edges("damping"),
        bend=bend,
        twist=compliance("torsional_stiffness"),
        cubic=cubic,
        viscous=bend * np.maximum(*of_nodes("material_damping")),
        rest_kappa=rest_kappa,
        rest_twist=np.zeros(nodes),
        gravity=np.array(limb.gravity, dtype=float),
        ghost=True,
        clamped=clamped_indices("ghost", (), nodes),
        segments=pairs,
        gain=gain,
        point_mass=masses_on_nodes(
            [(max(m.arc_length - limb.base_length, 0.0), m.mass) for m in limb.masses], rest
        ),
        base=limb.base_length,
    )


def _actuation(
    limb: Limb, rest: Array, pairs: tuple[tuple[int, int], ...], cubic: Array
) -> tuple[Array, Array]:
    """Return Λ (M,) [N/Pa] and the integrated curvature at rest (N, 2); change `cubic` (N,).

    The couples of a segment act in the middle of its first and last edge, so that n − 2 edges bend
    instead of the segment's length. Gain, curvature at rest and cubic stiffness are those at which
    the shorter length bends by the segment's angle.
    """
    gain, rest_kappa = np.zeros(len(pairs)), np.zeros((len(cubic), 2))
    for index, (segment, (first, size)) in enumerate(zip(limb.segments, pairs, strict=True)):
        inner = slice(first + 1, first + size - 1)
        step = rest[first]
        turn = segment.rest_curvature * segment.length / (size - 2)
        rest_kappa[inner, 0] = 2.0 * math.tan(0.5 * turn)
        ratio = segment.length / ((size - 2) * step)
        gain[index] = segment.moment_gain * ratio / step
        cubic[inner] /= ratio**2
    return gain, rest_kappa


def _segment_edges(
    limb: Limb, nodes: int
) -> tuple[NDArray[np.int64], Array, tuple[tuple[int, int], ...]]:
    """Return each edge's segment (-1 for a connector), its length, and the segments' nodes."""
    count = limb.segment_count
    lengths = np.array([segment.length for segment in limb.segments])
    available = nodes - 1 - (count - 1)
    share = lengths / lengths.sum() * available
    edges = np.maximum(2, np.floor(share).astype(int))
    while edges.sum() != available:
        gap = share - edges
        if edges.sum() < available:
            edges[len(gap) - 1 - int(np.argmax(gap[::-1]))] += 1
        else:
            edges[int(np.argmin(np.where(edges > 2, gap, np.inf)))] -= 1
    connector = limb.connector_length or float(lengths.sum()) / (nodes - 1)
    owner: list[int] = []
    rest: list[float] = []
    pairs: list[tuple[int, int]] = []
    for index, size in enumerate(edges):
        if index > 0:
            owner.append(-1)
            rest.append(connector)
        span = lengths[index]
        if limb.connector_length == 0.0:  # the connector edge is centred on the segments' boundary
            span -= 0.5 * connector * ((index > 0) + (index < count - 1))
        require(span > 0, "nodes", "large enough for the shortest segment", nodes)
        pairs.append((len(rest), int(size) + 1))
        owner.extend([index] * int(size))
        rest.extend([float(span) / int(size)] * int(size))
    return np.array(owner, dtype=np.int64), np.array(rest), tuple(pairs)
