"""What a bend angle is, the shapes of evenly bent limbs, and the bend that brings a tip to a point.

The bend angle of a segment is the heading where it ends less the heading where it starts [rad],
counter-clockwise positive, as tags on the stiff pieces between segments show it. A rod's heading
there is that of the edge between two segments, which belongs to neither (at the tip: of the last
edge; at the clamp: +x).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.arrays import Array
from der_planner.rod import Rod

PRIOR_WEIGHT = 1e-5
"""Pull toward the first guess [m/rad]: decides what the tip leaves open (straight limb, M > 2)."""
_ITERATIONS = 60
_SMALLEST_STEP = 1e-11
"""Change of the bend angles that ends the iteration [rad]."""


def end_edges(rod: Rod) -> list[int]:
    """Return the edge that has the heading of each segment's end, from the node of its number."""
    last = len(rod.rest_lengths) - 1
    return [min(first + count - 1, last) for first, count in rod.segments]


def bend_angles(rod: Rod, q: Array) -> Array:
    """Return the bend angles (…, K, M) [rad] of configurations in time (…, K, 4N-1).

    One configuration (4N-1,) gives (M,). A heading is known up to whole turns. In the first row
    each segment is taken to bend by less than half a turn; from row to row headings change by less
    than half a turn.
    """
    outputs = q[..., bend_outputs(rod)]
    dx = outputs[..., 2::4] - outputs[..., 0::4]
    dy = outputs[..., 3::4] - outputs[..., 1::4]
    headings = np.unwrap(np.arctan2(dy, dx), axis=-1)
    if headings.ndim > 1:
        headings = np.unwrap(headings, axis=-2)
    relative: Array = np.diff(headings, axis=-1, prepend=0.0)
    return relative


def bend_outputs(rod: Rod) -> list[int]:
    """Return the indices (4M) into q on which the bend angles depend, for `bend_change`."""
    return [4 * edge + place for edge in end_edges(rod) for place in (0, 1, 4, 5)]


def bend_change(rod: Rod, q: Array, moved: Array) -> Array:
    """Return the first-order change (K, M) of the bend angles [rad].

    Args:
        rod: of the configurations.
        q: (K, 4N-1).
        moved: (K, 4M) change of the coordinates `bend_outputs`, or (K, 4M, C) changes.
    """
    ends, ends_moved = (
        part.reshape(len(q), -1, 2, 2, *part.shape[2:]) for part in (q[:, bend_outputs(rod)], moved)
    )
    edge, change = (part[:, :, 1] - part[:, :, 0] for part in (ends, ends_moved))
    across = np.stack([-edge[..., 1], edge[..., 0]], axis=-1)
    turned = np.einsum("kma,kma...->km...", across / (edge**2).sum(-1, keepdims=True), change)
    relative: Array = np.diff(turned, axis=1, prepend=0.0)
    return relative


class TipOfBend(Protocol):
    """Where the tip is for given bend angles; angles are (..., M) rad, points (..., 2) m."""

    def tip(self, bend_angles: ArrayLike) -> Array:
        """Return the tip (..., 2)."""

    def tip_jacobians(self, bend_angles: ArrayLike) -> Array:
        """Return ∂tip/∂bend angles (..., 2, M)."""


class Kinematics(TipOfBend, Protocol):
    """The whole shape of a limb for given bend angles."""

    def curve(self, bend_angles: ArrayLike) -> Array:
        """Return the centreline (P, 2) of one configuration (M,)."""


class PolylineKinematics:
    """The planar chain of edges that a discrete rod forms when its segments bend evenly.

    Edge e has rest length ē_e and heading ψ_e = Σ_j W_ej θ_j. Segment j of n nodes from node a
    turns at its n − 2 inner nodes, hence W_ej = clip((e − a) / (n − 2), 0, 1).

    Args:
        rod: whose edges they are. Behind its first node, at x = ``base``, the limb is straight.
    """

    def __init__(self, rod: Rod) -> None:
        self.base, self.rest_lengths = rod.mesh.base, rod.rest_lengths
        edges = np.arange(len(self.rest_lengths))[:, None]
        first, count = np.array(rod.segments).reshape(-1, 2).T
        self.turning = np.clip((edges - first) / (count - 2), 0.0, 1.0)

    def _edges(self, bend_angles: ArrayLike) -> NDArray[np.complex128]:
        heading = np.asarray(bend_angles, dtype=float) @ self.turning.T
        edges: NDArray[np.complex128] = self.rest_lengths * np.exp(1j * heading)
        return edges

    def tip(self, bend_angles: ArrayLike) -> Array:
        """Return the tip (..., 2) [m] for bend angles (..., M) [rad]."""
        end = self.base + self._edges(bend_angles).sum(axis=-1)
        return np.stack([end.real, end.imag], axis=-1)

    def tip_jacobians(self, bend_angles: ArrayLike) -> Array:
        """Return ∂tip/∂bend angles (..., 2, M) [m/rad]."""
        columns = 1j * (self._edges(bend_angles) @ self.turning)
        return np.stack([columns.real, columns.imag], axis=-2)

    def curve(self, bend_angles: ArrayLike) -> Array:
        """Return the clamp and the nodes (P, 2) [m] of one configuration (M,) [rad]."""
        nodes = self.nodes(bend_angles)
        return np.concatenate([np.zeros((1, 2)), nodes]) if self.base else nodes

    def nodes(self, bend_angles: ArrayLike) -> Array:
        """Return the nodes (..., N, 2) [m] for bend angles (..., M) [rad]."""
        return self._placed(self._edges(bend_angles))

    def configuration(self, bend_angles: ArrayLike) -> Array:
        """Return q (..., 4N-1) of the evenly bent rod for bend angles (..., M) [rad]."""
        return coordinates(self.nodes(bend_angles))

    def _placed(self, edges: NDArray[np.complex128]) -> Array:
        """Return the nodes (..., N, 2) [m] of edges (..., N-1) from the base on."""
        nodes = _points(edges)
        nodes[..., 0] += self.base
        return nodes

    def edge_normals(self, bend_angles: ArrayLike) -> Array:
        """Return the left normals of the edges (..., N-1, 2), unit vectors."""
        normal = 1j * np.exp(1j * (np.asarray(bend_angles, dtype=float) @ self.turning.T))
        return np.stack([normal.real, normal.imag], axis=-1)

    def tangents(self, bend_angles: ArrayLike) -> Array:
        """Return S = ∂nodes/∂bend angles (..., M, N, 2) [m/rad]."""
        edges = self._edges(bend_angles)
        return _points(1j * edges[..., None, :] * self.turning.T)

    def motion(
        self, angles: ArrayLike, rates: ArrayLike, accelerations: ArrayLike
    ) -> tuple[Array, Array, Array]:
        """Return node positions, velocities and accelerations, (..., N, 2) each.

        With edge e = ē exp(iψ): ė = iψ̇ e and ë = (iψ̈ − ψ̇²) e.
        """
        edges = self._edges(angles)
        spin = np.asarray(rates) @ self.turning.T
        twirl = np.asarray(accelerations) @ self.turning.T
        return (
            self._placed(edges),
            _points(1j * spin * edges),
            _points((1j * twirl - spin**2) * edges),
        )


class TipNearPoses:
    """The tip of a limb whose weight bends it unevenly, near K poses that are known.

    tip(θ) = r_k + f(θ) − f(θ_k) + (J_k − f'(θ_k)) (θ − θ_k), with f of evenly bent segments: exact
    at the poses and to first order about them.

    Args:
        even: f.
        bend_angles: θ_k (K, M) [rad].
        tip: r_k (K, 2) [m].
        jacobian: J_k = ∂r_k/∂θ_k (K, 2, M) [m/rad].
    """

    def __init__(self, even: TipOfBend, bend_angles: Array, tip: Array, jacobian: Array) -> None:
        self._even, self._bend = even, bend_angles
        self._apart = tip - even.tip(bend_angles)
        self._slope = jacobian - even.tip_jacobians(bend_angles)

    def tip(self, bend_angles: ArrayLike) -> Array:
        """Return the tips (K, 2) [m] for bend angles (K, M) [rad], one near each pose."""
        away = np.asarray(bend_angles, dtype=float) - self._bend
        moved = self._apart + np.einsum("kam,km->ka", self._slope, away)
        found: Array = self._even.tip(bend_angles) + moved
        return found

    def tip_jacobians(self, bend_angles: ArrayLike) -> Array:
        """Return ∂tip/∂bend angles (K, 2, M) [m/rad]."""
        return self._even.tip_jacobians(bend_angles) + self._slope


def coordinates(nodes: Array) -> Array:
    """Return (..., 4N-1) of a rod whose nodes (..., N, 2) move in the plane without twist."""
    q = np.zeros((*nodes.shape[:-2], 4 * nodes.shape[-2] - 1))
    q[..., 0::4], q[..., 1::4] = nodes[..., 0], nodes[..., 1]
    return q


def _points(edges: NDArray[np.complex128]) -> Array:
    nodes = np.cumsum(edges, axis=-1)
    nodes = np.concatenate([np.zeros_like(nodes[..., :1]), nodes], axis=-1)
    return np.stack([nodes.real, nodes.imag], axis=-1)


def inverse_kinematics(
    kinematics: TipOfBend,
    tip: ArrayLike,
    guess: ArrayLike,
    prior_weight: float = PRIOR_WEIGHT,
    bounds: tuple[Array, Array] | None = None,
) -> tuple[Array, Array]:
    """Return bend angles (K, M) [rad] near the guess and the distances (K,) [m] that remain.

    Minimises |tip(θ) − r|² + w² |θ − guess|² for every point by Levenberg-Marquardt.

    Args:
        kinematics: forward kinematics.
        tip: (K, 2) points r [m].
        guess: (K, M) first guess, which also chooses the branch [rad].
        prior_weight: w [m/rad].
        bounds: least and largest bend angles (M,) [rad]; None: any.
    """
    target = np.atleast_2d(np.asarray(tip, dtype=float))
    prior = np.atleast_2d(np.asarray(guess, dtype=float))
    low, high = bounds or (np.full(prior.shape[1], -np.inf), np.full(prior.shape[1], np.inf))
    angles = np.clip(prior, low, high)
    damping = np.full(len(angles), 1e-9)
    identity = np.eye(angles.shape[1])
    weight = prior_weight**2

    def cost(theta: Array) -> Array:
        miss = kinematics.tip(theta) - target
        total: Array = (miss**2).sum(-1) + weight * ((theta - prior) ** 2).sum(-1)
        return total

    present = cost(angles)
    for _ in range(_ITERATIONS):
        miss = kinematics.tip(angles) - target
        jacobian = kinematics.tip_jacobians(angles)
        normal = np.einsum("kai,kaj->kij", jacobian, jacobian)
        normal = normal + (weight + damping)[:, None, None] * identity
        slope = np.einsum("kai,ka->ki", jacobian, miss) + weight * (angles - prior)
        # An angle at its bound stays there while the slope pushes it outward.
        tied = ((angles <= low) & (slope > 0)) | ((angles >= high) & (slope < 0))
        normal = np.where(tied[:, :, None] | tied[:, None, :], identity, normal)
        slope = np.where(tied, 0.0, slope)
        step = -np.linalg.solve(normal, slope[..., None])[..., 0]
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        step = step * np.minimum(1.0, 0.5 / np.maximum(length, 1e-300))
        moved = np.clip(angles + step, low, high)
        trial = cost(moved)
        better = trial <= present
        angles = np.where(better[:, None], moved, angles)
        present = np.where(better, trial, present)
        damping = np.where(better, np.maximum(damping / 10, 1e-16), damping * 10 + 1e-12)
        if np.all(length < _SMALLEST_STEP):
            break
    return angles, np.linalg.norm(kinematics.tip(angles) - target, axis=-1)
