"""How a limb gives way: closed forms of a cantilever, and the rod itself where it is bent."""

from dataclasses import replace

import numpy as np
import pytest

from der_planner.limb import Limb
from der_planner.model import RodModel
from der_planner.model.compliance import compliance

LIMB = replace(Limb.default(), connector_length=0.0, base_length=0.0)
LENGTH = LIMB.length
EI = LIMB.segments[0].bending_stiffness


@pytest.fixture(scope="module")
def model():
    return RodModel(LIMB, nodes=81)


@pytest.mark.parametrize("share", [0.4, 0.75, 1.0])
def test_a_force_across_a_straight_limb(model, share):
    """Euler-Bernoulli: a³/3EI where it acts, a²(3L − a)/6EI at the tip, turned by a²/2EI."""
    at = share * LENGTH
    found = compliance(model, [0.0, 0.0], [at])
    assert found.place[0, 1, 1] == pytest.approx(at**3 / (3 * EI), rel=5e-3)
    assert found.tip[0, 1, 1] == pytest.approx(at**2 * (3 * LENGTH - at) / (6 * EI), rel=5e-3)
    assert found.bend[0, :, 1].sum() == pytest.approx(at**2 / (2 * EI), rel=5e-3)
    # A force along a straight limb does nothing to first order.
    np.testing.assert_allclose(found.tip[0, :, 0], 0.0, atol=1e-12)


def test_pressures_bend_as_the_gains_say(model):
    found = compliance(model, [0.0, 0.0], [0.5 * LENGTH])
    np.testing.assert_allclose(found.bend_by_pressure, np.diag(LIMB.static_gain), rtol=2e-3)


def test_a_bent_limb_gives_way_as_the_rod_does():
    model = RodModel(LIMB)
    pressure = np.array([9000.0, -4000.0])
    at_rest = model.resting(pressure)
    node, force = 13, np.array([0.01, -0.02])
    forces = np.zeros((model.nodes, 3))
    forces[node, :2] = force
    pushed = model.rod.equilibrium(pressure, start=at_rest, forces=forces)
    place = float(np.cumsum(model.rod.rest_lengths)[node - 1])
    bend = model.bend_of(at_rest)
    found = compliance(model, bend, [place])
    np.testing.assert_allclose(found.tip[0] @ force, (pushed.q - at_rest.q)[-3:-1], rtol=0.03)
    np.testing.assert_allclose(found.bend[0] @ force, model.bend_of(pushed) - bend, rtol=0.03)


def test_a_force_across_the_tip_of_a_bent_limb(model):
    """Of a circular arc: F / EI ∫ arm² ds, with the arms along the tip's own heading."""
    bend = np.array([0.4, 0.4])
    found = compliance(model, bend, [LENGTH])
    across = np.array([-np.sin(0.8), np.cos(0.8)])
    s = np.linspace(0.0, LENGTH, 20001)
    radius = LENGTH / 0.8
    x, y = radius * np.sin(s / radius), radius * (1 - np.cos(s / radius))
    arm = (x[-1] - x) * np.cos(0.8) + (y[-1] - y) * np.sin(0.8)
    expected = np.sum(0.5 * (arm[1:] ** 2 + arm[:-1] ** 2)) * s[1] / EI
    assert across @ found.tip[0] @ across == pytest.approx(expected, rel=0.02)
