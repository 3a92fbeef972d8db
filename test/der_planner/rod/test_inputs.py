"""The couples of a segment: Theorem 1, Corollary 1 and the input matrix."""

import dataclasses

import numpy as np
import pytest

from der_planner.model.bending import PolylineKinematics, bend_angles
from der_planner.rod import Rod

EI = 0.02


def segment_rod(nodes: int = 12, segments=((0, 12),), plane=None) -> Rod:
    return Rod.uniform(
        length=0.24, nodes=nodes, EI=EI, EA=1000.0, GJ=0.015, mass_per_length=1.0, clamp="free",
        segments=segments, moment_gain=np.full(len(segments), 1e-5), plane=plane,
    )  # fmt: skip


def node_forces(force):
    return np.stack([force[axis::4] for axis in range(3)], axis=1)


@pytest.mark.parametrize("turn", [0.02, 0.1, -0.3, 0.6])
@pytest.mark.parametrize("plane", [None, "xy"])
def test_bending_forces_of_an_even_bend_are_two_couples(turn, plane):
    """Theorem 1: nothing inside, and |F| = 4 EI sinθ / (l ē (1 + cosθ)²) at the four end nodes."""
    rod = segment_rod(plane=plane)
    q = PolylineKinematics.of_rod(rod).configuration([turn * 10])
    forces = node_forces(rod.internal_force(q))
    step = rod.rest_lengths[0]
    magnitude = 4 * EI * abs(np.sin(turn)) / (step * step * (1 + np.cos(turn)) ** 2)
    np.testing.assert_allclose(forces[2:-2], 0.0, atol=1e-10 * magnitude)
    np.testing.assert_allclose(
        np.linalg.norm(forces[[0, 1, -2, -1]], axis=1), magnitude, rtol=1e-10
    )


def test_input_matrix_is_the_direction_against_bending():
    """Corollary 1: each segment's unit couples are −F_b/|F_b|, the connector carries nothing."""
    rod = segment_rod(segments=((0, 6), (6, 6)))
    q = PolylineKinematics.of_rod(rod).configuration([0.5, 0.8])
    forces = node_forces(rod.internal_force(q))
    matrix = rod.input_matrix(q) / rod.input_gain
    for index, (first, count) in enumerate(rod.segments):
        column = node_forces(matrix[:, index])
        inside = slice(first, first + count)
        ends = [first, first + 1, first + count - 2, first + count - 1]
        direction = forces[ends] / np.linalg.norm(forces[ends], axis=1)[:, None]
        np.testing.assert_allclose(column[ends], -direction, atol=1e-9)
        outside = np.ones(12, dtype=bool)
        outside[ends] = False
        np.testing.assert_array_equal(column[outside], 0.0)
        # a couple: no net force, no net moment of the two together
        np.testing.assert_allclose(column.sum(axis=0), 0.0, atol=1e-14)
        moment = np.cross(rod.positions(q)[inside], column[inside]).sum(axis=0)
        np.testing.assert_allclose(moment, 0.0, atol=1e-14)
    assert not matrix[3::4].any()


def test_pressure_bends_as_the_continuum_does():
    """The couples span N_j − 2 edges, the gain makes up for it: angle = G u L / EI if small."""
    for count in (5, 9, 20):
        rod = segment_rod(nodes=count, segments=((0, count),), plane="xy")
        clamped = Rod(dataclasses.replace(rod.mesh, clamped=np.arange(7)), "xy")
        pressure = 100.0
        angle = bend_angles(clamped, clamped.equilibrium([pressure]).q)
        assert angle[0] == pytest.approx(1e-5 * pressure * 0.24 / EI, rel=1e-4)
