"""The rod of a limb: its mesh, its gain, its rest shape, and what the caller gets wrong."""

import dataclasses

import numpy as np
import pytest
from limbs import with_segments

from der_planner.limb import Limb
from der_planner.model.bending import PolylineKinematics, bend_angles
from der_planner.rod import ConvergenceError, Rod


def joined(connector: float) -> Limb:
    """Return the default limb with another length of what joins its segments [m]."""
    return dataclasses.replace(Limb.default(), connector_length=connector)


@pytest.mark.parametrize("nodes", [11, 20, 21, 22, 40])
@pytest.mark.parametrize("connector", [0.0, 0.01])
def test_mesh_covers_the_limb(nodes, connector):
    limb = with_segments(joined(connector), length=[0.1, 0.15])
    rod = Rod.from_limb(limb, nodes)
    assert rod.nodes == nodes
    assert rod.plane == "xy"
    assert rod.rest_lengths.sum() == pytest.approx(limb.length)
    (first, count), (second, second_count) = rod.segments
    assert (first, second, second_count) == (0, count, nodes - count)
    ends = np.append(0.0, np.cumsum(rod.rest_lengths))
    boundary = 0.5 * (ends[count - 1] + ends[count])
    assert boundary == pytest.approx(0.1 + 0.5 * connector)
    assert rod.mass_diagonal[0::4].sum() == pytest.approx(1.066 * limb.length)


@pytest.mark.parametrize("connector", [0.0, 0.015])
def test_static_bend_angles_are_those_of_the_segments(connector):
    limb = with_segments(
        joined(connector),
        length=[0.1, 0.15],
        bending_stiffness=[0.02, 0.0175],
        moment_gain=[9.1e-6, 7e-6],
        rest_curvature=[0.8, -0.5],
    )
    rod = Rod.from_limb(limb)
    u = np.array([4e3, -6e3])
    expected = limb.static_gain * u + [0.8 * 0.1, -0.5 * 0.15]
    state = rod.equilibrium(u)
    np.testing.assert_allclose(bend_angles(rod, state.q), expected, rtol=3e-3)
    q = PolylineKinematics(rod).configuration(bend_angles(rod, state.q))
    np.testing.assert_allclose(q, state.q, atol=1e-9)


def test_a_short_connector_does_not_keep_a_curved_limb_from_its_rest():
    limb = with_segments(joined(5e-4), rest_curvature=[-3.0, -1.0])
    rod = Rod.from_limb(limb, 13)
    found = bend_angles(rod, rod.equilibrium(np.zeros(2)).q)
    np.testing.assert_allclose(found, [-3.0 * 0.122, -0.122], rtol=1e-6)


def test_cubic_stiffness_is_the_segments_law():
    stiffening = 2e-5
    limb = with_segments(Limb.default(), cubic_stiffness=stiffening)
    rod = Rod.from_limb(limb, 41)
    u = np.array([1e4, -1.5e4])
    curvature = bend_angles(rod, rod.equilibrium(u).q) / 0.122
    moment = 0.0175 * curvature + stiffening * curvature**3
    np.testing.assert_allclose(moment, 9.1e-6 * u, rtol=3e-3)
    assert np.all(np.abs(curvature) < 0.98 * np.abs(9.1e-6 * u / 0.0175))


def test_gravity_out_of_the_plane_makes_the_rod_spatial():
    rod = Rod.from_limb(dataclasses.replace(Limb.default(), gravity=(0.0, 0.0, -9.81)))
    assert rod.plane is None
    sagging = rod.equilibrium([8e3, 8e3])
    assert rod.tip(sagging)[2] < -0.005
    assert rod.tip(sagging)[1] > 0.02


NOTHING = np.zeros(2)
STILL = np.zeros((3, 2))


@pytest.mark.parametrize(
    ("method", "arguments", "message"),
    [
        ("step", ([1.0], 0.01), r"u must have shape \(2,\), got \(1,\)"),
        ("step", ([1.0, np.nan], 0.01), "u must be finite"),
        ("step", (NOTHING, 0.0), "dt must be a positive number"),
        ("step", (NOTHING, 0.1, "euler"), "method must be one of"),
        ("simulate", (np.zeros(3), 0.1), "pressures must be"),
        ("linearise_step", (NOTHING, -0.1), "dt must be a positive number"),
    ],
)
def test_bad_arguments_of_a_motion_are_named(method, arguments, message):
    rod = Rod.from_limb(Limb.default())
    with pytest.raises(ValueError, match=message):
        getattr(rod, method)(rod.straight_state(), *arguments)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda rod: rod.state(np.ones(83)), "q must stay in the plane xy"),
        (lambda rod: rod.equilibrium([0, 0], forces=np.ones((21, 3))), "forces must stay in"),
        (
            lambda rod: rod.simulate(rod.straight_state(), STILL, 0.1, substeps=0),
            "substeps must be an int of 1 or more, got 0",
        ),
        (
            lambda rod: rod.simulate(rod.straight_state(), STILL, 0.1, linearise=True, outputs=[2]),
            "outputs must be",
        ),
        (lambda _: Rod.from_limb(Limb.default(), 4), "nodes must be an int of 6 or more"),
        (lambda _: Rod.from_limb(Limb.default(), plane="yz"), "plane must be"),
    ],
)
def test_bad_input_is_named_at_the_border(call, message):
    with pytest.raises(ValueError, match=message):
        call(Rod.from_limb(Limb.default()))


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"EI": -1.0}, "EI must be a positive number, got -1.0"),
        ({"damping": -0.1}, "damping must be 0 or more"),
        ({"clamp": "pinned"}, "clamp must be 'ghost', 'inside' or 'free'"),
        ({"segments": [(0, 6), (5, 6)], "moment_gain": [1, 1]}, "sharing no node"),
        ({"segments": [(0, 12)], "moment_gain": [1]}, "within 11 nodes"),
        ({"segments": [(0, 5)]}, r"moment_gain must have shape \(1,\)"),
        ({"gravity": (0, 0, -9.81), "plane": "xy"}, "gravity must stay in the plane xy"),
        ({"fixed": [99]}, "fixed must be"),
    ],
)
def test_bad_parameters_are_named(option, message):
    good = {"length": 0.2, "nodes": 11, "EI": 0.02, "EA": 1e3, "GJ": 0.02, "mass_per_length": 1.0}
    with pytest.raises(ValueError, match=message):
        Rod.uniform(**{**good, **option})


@pytest.mark.parametrize("plane", ["xy", None])
def test_a_step_that_does_not_converge_raises_and_says_where(plane):
    rod = Rod.from_limb(Limb.default(), plane=plane)
    state = rod.straight_state()
    good = rod.step(state, [1e3, 1e3], 0.02)
    pressures = np.array([[1e3, 1e3], [1e9, -1e9]])
    with pytest.raises(ConvergenceError, match=r"step 1 of 0\.02 s") as caught:
        rod.simulate(state, pressures, 0.02)
    assert caught.value.step == 1
    assert caught.value.iterations > 0
    assert not caught.value.residual < 1e-9
    np.testing.assert_allclose(caught.value.state.q, good.q, atol=1e-12)


def test_fixed_degrees_of_freedom_do_not_move():
    rod = Rod.uniform(
        length=0.2, nodes=11, EI=0.02, EA=1e3, GJ=0.02, mass_per_length=1.0, gravity=(0, 0, -9.81),
        fixed=[4 * 10 + 2, 3],
    )  # fmt: skip
    assert not {42, 3, 0, 1, 2} & set(rod.free.tolist())
    state = rod.straight_state()
    for _ in range(20):
        state = rod.step(state, [], 0.01)
    assert state.q[42] == 0.0
    assert state.q[3] == 0.0
    assert state.q[4 * 5 + 2] < -1e-4
