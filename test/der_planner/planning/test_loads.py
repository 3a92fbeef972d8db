"""Plans under gravity and with payloads: they begin and end at rest, reach, refuse and name."""

import dataclasses

import numpy as np
import pytest
from limbs import with_air, with_segments

from der_planner.limb import GRAVITY, Limb
from der_planner.model import RodModel
from der_planner.planning import (
    METHODS,
    BucklingError,
    Motion,
    OverloadError,
    PlanningError,
    plan,
)

pytestmark = pytest.mark.slow

LIMB = Limb.default()
SPATIAL = dataclasses.replace(LIMB, gravity=(0.0, 0.0, -4.0))


def stiffer(limb, factor):
    return with_segments(
        limb,
        bending_stiffness=lambda s: factor * s.bending_stiffness,
        moment_gain=lambda s: factor * s.moment_gain,
    )


MOUNTED = {
    "hanging": stiffer(LIMB, 1.3).mounted("hanging"),
    "tilted, with a payload": LIMB.mounted("15").carrying(0.02),
    "sideways": stiffer(LIMB, 3.0).mounted("sideways"),
    "standing": stiffer(LIMB, 1.5).mounted("standing").carrying(0.01),
}


@pytest.mark.parametrize(
    ("mounting", "name", "amplitude"),
    [
        ("hanging", "asynchronous", 0.3),
        ("hanging", "circle", 0.5),
        ("tilted, with a payload", "same_direction", 0.3),
        ("sideways", "circle", 0.5),
        ("standing", "asynchronous", 0.3),
    ],
)
def test_plans_begin_and_end_at_rest_and_reach_their_reference(mounting, name, amplitude):
    limb = MOUNTED[mounting]
    period = 12.0 if name == "circle" else 6.0  # a circle is drawn at 1.2 times its amplitude
    result = plan(limb, Motion.named(name, amplitude, period, cycles=1))
    # The circle takes the hanging limb to its limit of pressure.
    assert result.largest_error < (1.2e-3 if (mounting, name) == ("hanging", "circle") else 5e-4)
    assert result.warnings == ()
    # The limb that is drawn sags as the one that is planned.
    drawn = np.array([result.curve(k)[-1] for k in range(len(result.time))])
    np.testing.assert_allclose(drawn, result.tip_reference, atol=1e-3)
    for end in (0, -1):
        np.testing.assert_allclose(
            result.tip_reference[end], RodModel(limb).rest.q[-3:-1], atol=1e-9
        )
    assert np.abs(result.differential_pressure[[0, -1]]).max() < 60.0


def test_a_path_is_kept_whatever_the_limb_carries():
    turn = np.linspace(0.0, 2 * np.pi, 121)
    path = np.column_stack([0.222 + 0.004 * np.cos(turn), 0.07 + 0.01 * np.sin(turn)])
    for limb in (LIMB.mounted("hanging"), LIMB.mounted("hanging").carrying(0.03)):
        result = plan(limb, Motion.from_tip_path(0.05 * np.arange(121), path))
        assert result.largest_error < 5e-4
        apart = np.linalg.norm(result.tip_reference[:, None] - path[None], axis=2).min(axis=0)
        assert apart.max() < 2e-4


@pytest.mark.parametrize("method", METHODS["der"])
@pytest.mark.parametrize("model", METHODS)
def test_every_method_knows_the_load(model, method):
    limb = LIMB.mounted("hanging").carrying(0.02)
    result = plan(limb, Motion.named("opposite_direction", 0.4, 10.0, 1), model, method)
    assert result.predicted_error < 5e-4
    unloaded = dataclasses.replace(limb, gravity=(0.0, 0.0, 0.0))
    light = plan(unloaded, Motion.named("opposite_direction", 0.4, 10.0, 1), model, method)
    most = [np.abs(p.differential_pressure[:, 0]).max() for p in (result, light)]
    assert most[0] > 1.5 * most[1]


# What pressure cannot do ---------------------------------------------------------------------


@pytest.mark.parametrize("model", METHODS)
def test_a_payload_that_cannot_be_lifted_is_refused_with_what_could_be(model):
    limb, motion = LIMB.mounted("hanging"), Motion.named("same_direction", 0.6, 12.0, 1)
    with pytest.raises(OverloadError) as refused:
        plan(limb.carrying(0.2), motion, model)
    error = refused.value
    assert error.required_pressure > error.pressure_limit == LIMB.pneumatics.pressure_limit
    assert 0.0 < error.possible_mass < 0.2
    assert f"{error.required_pressure / 1000:.1f} kPa" in str(error)
    assert f"{error.possible_mass * 1000:.1f} g are possible" in str(error)
    plan(limb.carrying(0.95 * error.possible_mass), motion, model, "projected")
    with pytest.raises(OverloadError):
        plan(limb.carrying(1.1 * error.possible_mass), motion, model, "projected")


def test_a_payload_far_too_heavy_is_named_where_the_limb_cannot_even_take_the_shape():
    motion = Motion.named("asynchronous", 0.35, 8.0, 1)
    for mounting, mass in (("hanging", 0.5), ("sideways", 2.0)):
        said = rf"out of reach.*It carries {1000 * mass:.1f} g: carry less"
        with pytest.raises(PlanningError, match=said):
            plan(LIMB.mounted(mounting).carrying(mass), motion, "der", "projected")


def test_arcs_that_rest_elsewhere_or_know_nothing_of_a_sag_say_so():
    motion = Motion.named("asynchronous", 0.2, 20.0, 1)
    for method in METHODS["pcc"]:
        said = plan(LIMB.mounted("sideways").carrying(0.05), motion, "pcc", method).warnings
        assert any("mm off, since it rests elsewhere than the limb" in text for text in said)
        assert not any("a longer period" in text for text in said if "misses the" in text)
        assert not any("the limits leave" in text for text in said)
    level = dataclasses.replace(LIMB, gravity=(0.0, 0.0, -GRAVITY))
    with pytest.raises(PlanningError, match=r"plan with the rod \(der\)"):
        plan(level, motion, "pcc", "projected")


def test_a_weight_of_its_own_that_is_too_much_is_named_so():
    with pytest.raises(OverloadError, match=r"Even without the 50\.0 g that it carries"):
        plan(LIMB.mounted("hanging").carrying(0.05), Motion.named("same_direction", 0.79, 8.0, 1))
    with pytest.raises(PlanningError, match="out of reach"):
        plan(LIMB.mounted("hanging"), Motion.from_tip_path(None, [[0.3, 0.0], [0.3, 0.1]]))


def test_a_limb_that_hardly_stands_says_so():
    motion = Motion.named("same_direction", 0.1, 6.0, 1)
    for factor, share in ((1.16, "96 %"), (1.3, "")):
        limb = stiffer(LIMB, factor).mounted("standing")
        said = [
            text for text in plan(limb, motion, "der", "projected").warnings if "buckle" in text
        ]
        assert len(said) == (1 if share else 0)
        assert all(f"stands under {share} of the load" in text for text in said)


def test_a_standing_limb_beyond_its_critical_load_is_refused_by_name():
    """Greenhill: a column under its own weight buckles at q L³ / EI = 7.837."""
    standing = LIMB.mounted("standing")
    segment = LIMB.segments[0]
    weight = segment.mass_per_length * GRAVITY
    share = 7.837 * segment.bending_stiffness / LIMB.length**3 / weight
    assert share < 1
    motion = Motion.named("same_direction", 0.1, 8.0, 1)
    for model in METHODS:
        with pytest.raises(BucklingError, match="buckles under") as refused:
            plan(standing, motion, model)
        said = float(str(refused.value).split("(")[1].split(" of them")[0])
        assert said == pytest.approx(share, abs=0.02)
    assert plan(stiffer(standing, 1.05 / share), motion).largest_error < 5e-4


@pytest.mark.parametrize("model", METHODS)
def test_a_leaning_limb_beyond_its_critical_load_is_refused_by_name(model):
    """It is bent by its rest curvature, so that Newton's method may find a fallen rest."""
    for curvature in (0.2, 2.0):
        bent = with_segments(LIMB, rest_curvature=curvature).mounted("standing").carrying(0.1)
        with pytest.raises(BucklingError, match=r"does not stay upright|may fall to either side"):
            plan(bent, Motion.named("same_direction", 0.1, 8.0, 1), model)


@pytest.mark.parametrize(("model", "amplitude"), [("der", 2.0), ("pcc", 2.6)])
def test_a_pose_that_would_snap_through_is_named(model, amplitude):
    """A soft limb that is bent far up against its weight falls over at some point."""
    limb = with_air(stiffer(LIMB, 0.1).mounted("hanging"), pressure_limit=1e7)
    with pytest.raises(BucklingError, match="snap through"):
        plan(limb, Motion.named("same_direction", amplitude, 20.0, 1), model, "projected")


# Out of the plane ------------------------------------------------------------------------------


def test_a_limb_that_sags_out_of_its_plane_is_planned_from_where_it_rests():
    motion = Motion.named("opposite_direction", 0.3, 6.0, 1)
    result = plan(SPATIAL, motion, nodes=13)
    sag = RodModel(SPATIAL, 13).rest.q[-1]
    assert sag < -0.04
    assert result.largest_error < 1.5e-3
    assert result.predicted_error < 3e-4
    flat = plan(LIMB, motion, "pcc", "paper")
    assert np.abs(result.tip_reference - flat.tip_reference)[0].max() > 5e-3
