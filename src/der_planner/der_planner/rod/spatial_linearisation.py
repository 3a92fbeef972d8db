"""The exact linearisation of one backward Euler stage of a rod in space.

The unknowns are a chart: reference directors are transported from the base configuration, and φ is
counted
from them. Away from the base the transport itself depends on the tangents (holonomy): a change δt
turns the director about t by g·δt, g = t×t̂ / (1 + t̂·t), beyond what transport from the present
tangent would do, and a change δt̂ of the base turns it by g·δt̂. The force formula is not a
gradient in this chart, so its derivative is not symmetric: each edge adds half its twisting torque
times [t]×/|e|².
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from der_planner.rod import spatial_assembly_kernel, spatial_kernel
from der_planner.rod.backend import band_to_dense
from der_planner.rod.state import Array, Arrays


@dataclass(frozen=True)
class Stage:
    """A solved stage: x at rate = 1/h from x_n with the reference frames at x_n.

    Attributes:
        x: (4n-1,) solution. x_n: (4n-1,) base. rate: 1/h. u: (M,) pressures.
        tangents: (n-1, 3). directors: (n-1, 3). twists_n: (n,).
    """

    x: Array
    x_n: Array
    rate: float
    u: Array
    tangents: Array
    directors: Array
    twists_n: Array


def holonomy(start: Array, end: Array) -> tuple[Array, Array]:
    """Return g, ĝ (E, 3): turning of P(start→end) d about `end` by changes of `end` and of `start`.

    Args:
        start: (E, 3) edges, not normalised.
        end: (E, 3) likewise; g and ĝ are by edge vectors.
    """
    long, short = np.linalg.norm(end, axis=1), np.linalg.norm(start, axis=1)
    t, b = end / long[:, None], start / short[:, None]
    normal = np.cross(t, b) / (1.0 + np.sum(b * t, axis=1))[:, None]
    return normal / long[:, None], normal / short[:, None]


def cross_matrix(a: Array) -> Array:
    """Return [a]× (3, 3)."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def edge_vectors(x: Array) -> Array:
    """Return the (n-1, 3) edges of kernel coordinates."""
    return np.diff(np.stack([x[0::4], x[1::4], x[2::4]], axis=1), axis=0)


def gauge_columns(columns: Array, g: Array) -> Array:
    """Return by-x columns that a turning g·δe of each edge's frame adds, from the by-φ columns."""
    result = np.zeros((columns.shape[0], 4 * len(g) + 3))
    for j in range(len(g)):
        turned = np.outer(columns[:, 4 * j + 3], g[j])
        result[:, 4 * j + 4 : 4 * j + 7] += turned
        result[:, 4 * j : 4 * j + 3] -= turned
    return result


def edge_block(matrix: Array, j: int, block: Array) -> None:
    """Add a derivative (3, 3) of an edge's force by its vector to the nodes' matrix."""
    a, b = slice(4 * j, 4 * j + 3), slice(4 * j + 4, 4 * j + 7)
    matrix[a, a] += block
    matrix[b, b] += block
    matrix[a, b] -= block
    matrix[b, a] -= block


def residual_derivatives(stage: Stage, rod: Arrays, space: Arrays) -> tuple[Array, Array, Array]:
    """Return ∂R/∂x, ∂R/∂x_n without inertia and drag (4n-1, 4n-1), and B(q)Λ (4n-1, M).

    Args:
        stage: where.
        rod: the kernels' rod arrays.
        space: the backend's work arrays.
    """
    twists, _, s, frame, own, link, local, vectors, _ = space
    size = len(stage.x)
    spatial_kernel.frames(stage.x, stage.tangents, stage.directors, frame)
    spatial_kernel.reference_twists(frame, stage.twists_n, twists)
    v = (stage.x - stage.x_n) * stage.rate
    gradient = np.zeros(size)
    spatial_assembly_kernel.assemble(
        stage.x, v, 0.0, 0.0 * stage.u, False, gradient, s, frame, twists, own, link, local,
        vectors, rod,
    )  # fmt: skip
    elastic = band_to_dense(s)
    for j in range(len(frame)):
        t, inverse = frame[j, :3], frame[j, 3]
        edge_block(elastic, j, 0.5 * gradient[4 * j + 3] * inverse**2 * cross_matrix(t))
    drag = np.zeros((size, size))
    viscous = rod[5]
    for i in np.flatnonzero(viscous[1:-1]) + 1:
        _add_viscous(int(i), stage, viscous[i], frame, twists, v, vectors, elastic, drag)
    edges = edge_vectors(stage.x)
    g, g_start = holonomy(edge_vectors(stage.x_n), edges)
    by_x = elastic + gauge_columns(elastic, g) + drag
    by_x_n = gauge_columns(elastic, g_start) - drag
    first, last, gain = rod[8], rod[9], rod[10]
    columns = np.zeros((size, len(gain)))
    spatial_kernel.input_columns(frame, rod, columns)
    spin = cross_matrix(np.array([0.0, 0.0, 1.0]))
    for m in range(len(gain)):
        for j, sign in ((first[m], -1.0), (last[m], 1.0)):
            t = frame[j, :3]
            turned = spin @ (np.eye(3) - np.outer(t, t)) * frame[j, 3]
            edge_block(by_x, int(j), -sign * gain[m] * stage.u[m] * turned)
    return by_x, by_x_n, columns


def propagate(
    stage: Stage,
    derivatives: tuple[Array, Array, Array],
    mass: Array,
    damping: Array,
    free: NDArray[np.int64],
    extrapolate: float,
    change: tuple[Array, Array],
) -> tuple[Array, Array]:
    """Carry changes (δq, δv), each (4n-1, C) with M input columns last, through a stage.

    Args:
        stage: the solved stage.
        derivatives: of `residual_derivatives`.
        mass: (4n-1,) diagonal.
        damping: (4n-1,) diagonal.
        free: indices that move.
        extrapolate: e of the stage.
        change: at the base, in its chart.

    Returns:
        The changes at the extrapolated state, in the chart of its own frames.
    """
    by_x, by_x_n, inputs = derivatives
    dq, dv = change
    rate = stage.rate
    inertia = rate * (mass * rate + damping)
    right = inertia[:, None] * dq - by_x_n @ dq + rate * mass[:, None] * dv
    right[:, dq.shape[1] - inputs.shape[1] :] += inputs
    matrix = (by_x + np.diag(inertia))[np.ix_(free, free)]
    solved = np.zeros_like(dq)
    solved[free] = np.linalg.solve(matrix, right[free])
    move = solved - dq
    out_q = dq + extrapolate * move
    out_v = dv + extrapolate * (rate * move - dv)
    end = stage.x_n + extrapolate * (stage.x - stage.x_n)
    g_end, g_start = holonomy(edge_vectors(stage.x_n), edge_vectors(end))
    for j in range(len(g_end)):
        here, there = slice(4 * j, 4 * j + 3), slice(4 * j + 4, 4 * j + 7)
        out_q[4 * j + 3] += g_end[j] @ (out_q[there] - out_q[here])
        out_q[4 * j + 3] += g_start[j] @ (dq[there] - dq[here])
    return out_q, out_v


def _add_viscous(
    i: int,
    stage: Stage,
    strength: float,
    frame: Array,
    twists: Array,
    v: Array,
    vectors: Array,
    elastic: Array,
    drag: Array,
) -> None:
    """Add c ∇κ (∇²κ v)ᵀ to `elastic` and c rate ∇κ ∇κᵀ to `drag` for both curvatures of node i."""
    strain, gradient = np.zeros(8), np.zeros((3, 8))
    spatial_kernel.node_strains(i, frame, twists, stage.x, strain, gradient)
    # nodes' unknowns (11,) to (e, φe, f, φf) (8,)
    to_edges = np.zeros((8, 11))
    to_edges[0:3, 0:3], to_edges[0:3, 4:7], to_edges[3, 3] = -np.eye(3), np.eye(3), 1.0
    to_edges[4:7, 4:7], to_edges[4:7, 8:11], to_edges[7, 7] = -np.eye(3), np.eye(3), 1.0
    span = slice(4 * i - 4, 4 * i + 7)
    rate = to_edges @ v[span]
    for k in range(2):
        h = np.zeros((8, 8))
        spatial_kernel.add_curvature_hessian(
            i, float(k == 0), float(k == 1), 0.0, frame, strain, vectors, h
        )
        lower = np.tril(h)
        full = lower + np.tril(h, -1).T
        for side, j in ((0, i - 1), (1, i)):
            part = slice(4 * side, 4 * side + 3)
            turning = 0.5 * gradient[k, 4 * side + 3] * frame[j, 3] ** 2
            full[part, part] += turning * cross_matrix(frame[j, :3])
        outward = to_edges.T @ gradient[k]
        change = to_edges.T @ (full.T @ rate)
        elastic[span, span] += strength * np.outer(outward, change)
        drag[span, span] += strength * stage.rate * np.outer(outward, outward)
