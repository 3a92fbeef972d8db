"""Forces on the rod are found from what its bend and tip lack, and commands do not raise them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from limbs import with_segments

from der_planner.control.reaction import Reaction
from der_planner.estimation.force import locate, untouched
from der_planner.estimation.free_level import FreeLevel, Lacking
from der_planner.estimation.knowledge import Knowledge
from der_planner.estimation.touch import TouchSense
from der_planner.limb import Limb
from der_planner.model import RodModel
from der_planner.model.compliance import compliance
from der_planner.model.material import Memory

LIMB = replace(Limb.default(), connector_length=0.0, base_length=0.0)
DEVIATION = np.array([40.0, 40.0, 2e-4, 2e-4])
STILL = Lacking(0.0, *np.zeros((3, 2)), np.zeros(4), np.zeros((4, 4)), np.zeros((2, 2)))
"""A limb that lacks nothing and does not rub."""
KNOWN = replace(STILL, covariance=np.diag((DEVIATION / 4) ** 2))
"""The same, as well as the estimator knows it."""


@pytest.fixture(scope="module")
def model():
    return RodModel(LIMB)


def calibrated() -> FreeLevel:
    """Return the free level of a limb that is well known."""
    free = FreeLevel(LIMB)
    still = replace(STILL, covariance=1e-12 * np.eye(4))
    for k in range(4000):
        away = DEVIATION * (-1) ** k
        felt = replace(still, effective=np.array([k % 7, k % 5]) * 1e3, value=away)
        mean, variance = free.expected(felt, 0.5)
        free.learn(felt, 0.5, away - mean, variance)
    return free


def lacking(model, forces, pressure=(6000.0, 3000.0)) -> Lacking:
    """Return what a model lacks that knows nothing of forces [N] at nodes of its rod."""
    pressures, applied = np.array(pressure), np.zeros((model.nodes, 3))
    for node, force in forces.items():
        applied[node, :2] = force
    free = model.resting(pressures)
    pushed = model.rod.equilibrium(pressures, start=free, forces=applied)
    bend, before = model.bend_of(pushed), model.bend_of(free)
    missing = np.linalg.solve(compliance(model, bend, [0.1]).bend_by_pressure, bend - before)
    even = model.kinematics
    offset = (pushed.q - free.q)[-3:-1] - (even.tip(bend) - even.tip(before))
    value = np.concatenate([missing, offset])
    return replace(KNOWN, time=1.0, bend_angles=bend, effective=pressures, value=value)


def frame(model, node, bend) -> np.ndarray:
    """Return the directions along and across the limb at a node, as columns."""
    heading = model.kinematics.turning[node - 1] @ bend
    return np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])


def looked(sense, felt, shares, begin=0.0, driven=0.0):
    """Have shares of what a limb lacks looked at, 30 a second; return what is said of each.

    The limb may be driven against it, by as much of its pressures as ``driven`` says.
    """
    against = driven * felt.value[:2]
    return [
        sense.look(
            replace(
                felt,
                time=begin + k / 30,
                value=share * felt.value,
                effective=felt.effective - share * against,
            )
        )
        for k, share in enumerate(shares)
    ]


@pytest.mark.parametrize("node", [10, 15, 20])
@pytest.mark.parametrize("pushed", [(0.0, 0.1), (0.05, -0.2)])
def test_a_force_is_found_with_its_place(model, node, pushed):
    """A force along and across the limb [N]: that of something that touches it from its side."""
    force = frame(model, node, lacking(model, {}).bend_angles) @ pushed
    felt = lacking(model, {node: force})
    touch = TouchSense(model, calibrated()).look(felt)
    assert touch.touched
    assert touch.since == 1.0
    place = node / 20 * LIMB.length
    told = np.isfinite(touch.place)
    assert told == (touch.place_deviation < 0.1 * LIMB.length)
    assert not told or abs(touch.place - place) < max(0.05 * LIMB.length, touch.place_deviation)
    assert told or node == 10
    apart = touch.force - force
    assert apart @ np.linalg.solve(touch.force_covariance, apart) < 9.0
    # How strong it is along the limb is hardly told.
    axes = frame(model, node, felt.bend_angles)
    doubt = float(np.sqrt((axes.T @ touch.force_covariance @ axes)[1, 1]))
    assert abs((apart @ axes)[1]) < max(0.15 * abs((force @ axes)[1]), doubt)


def test_a_force_that_noise_hardly_lets_tell_is_not_taken_for_a_large_one(model):
    spread = np.diag(np.array([300.0, 300.0, 1e-3, 1e-3]) ** 2)
    felt, draw = lacking(model, {15: (0.0, -0.15)}), np.random.default_rng(6)
    places, forces = np.linspace(0.0, LIMB.length, 61)[1:], []
    for noise in draw.multivariate_normal(np.zeros(4), spread, 200):
        noisy = replace(felt, value=felt.value + noise, covariance=spread)
        forces.append(np.linalg.norm(locate(model, noisy, places).force))
    assert np.nanmedian(forces) == pytest.approx(0.15, rel=0.4)


def test_a_force_at_the_tip_is_found_there_though_noise_leaves_other_places(model):
    felt, draw = lacking(model, {20: (0.0, -0.3)}), np.random.default_rng(6)
    places, spread = np.linspace(0.0, LIMB.length, 61)[1:], np.diag(DEVIATION**2)
    noises = draw.multivariate_normal(np.zeros(4), spread, 50)
    each = [replace(felt, value=felt.value + noise, covariance=spread) for noise in noises]
    found = [locate(model, one, places).place for one in each]
    assert np.nanmedian(found) > 0.98 * LIMB.length


def test_a_force_counts_by_the_stiffness_that_swings_told(model):
    felt, places = lacking(model, {20: (0.0, -0.3)}), np.linspace(0.0, LIMB.length, 61)[1:]
    own = [segment.bending_stiffness for segment in LIMB.segments]
    softer = replace(LIMB.calibrated, bending_stiffness=tuple(0.8 * value for value in own))
    known = RodModel(replace(LIMB, calibrated=softer))
    sizes = [np.linalg.norm(locate(each, felt, places).force) for each in (model, known)]
    assert sizes[1] == pytest.approx(0.8 * sizes[0], rel=0.02)


def test_a_limb_file_that_knows_the_free_level_makes_a_first_run_feel_more(model):
    covered = replace(LIMB.calibrated, differential_pressure=(1e4, 1e4))
    bare = replace(LIMB, calibrated=covered)
    known = replace(LIMB, calibrated=replace(covered, free_level=calibrated().told()))
    felt = lacking(model, {15: (0.0, -0.2)})
    less, more = (TouchSense(model, FreeLevel(limb)).look(felt) for limb in (bare, known))
    assert more.distance > 1.5 * less.distance
    # Mounted otherwise it may lack something else.
    other, first = (FreeLevel(limb.mounted("sideways")).told() for limb in (known, bare))
    assert other == first


def test_what_cannot_be_told_is_not_told(model):
    # Along a straight limb.
    pulled = TouchSense(model, calibrated()).look(lacking(model, {20: (0.5, 0.0)}, (0.0, 0.0)))
    assert not pulled.touched
    # Near the clamp a force moves next to nothing.
    near = TouchSense(model, calibrated()).look(lacking(model, {3: (0.0, 0.8)}))
    assert not near.touched or np.isnan(near.place) or near.place < 0.3 * LIMB.length
    # A pair of forces in mid-limb and at the tip.
    two = TouchSense(model, calibrated()).look(
        lacking(model, {7: (0.0, -1.5), 20: (0.0, 0.3)}, (0.0, 0.0))
    )
    assert two.touched
    assert np.isnan(two.place)


def test_a_limb_that_is_known_from_an_earlier_run_feels_more_though_it_rests_otherwise(model):
    rests, felt = np.array([300.0, -200.0, 1e-3, 0.0]), []
    hit = lacking(model, {15: (0.0, 0.1)})
    for free in (FreeLevel(LIMB), calibrated().for_next_run()):
        sense = TouchSense(model, free)
        for k in range(60):
            assert not sense.look(replace(KNOWN, time=k / 30, value=rests)).touched
        felt.append(sense.look(replace(hit, time=2.0, value=hit.value + rests)).touched)
    assert felt == [False, True]


def test_doubt_ends_no_touch(model):
    sense, hit = TouchSense(model, calibrated()), lacking(model, {20: (0.0, 0.2)})
    swings = replace(hit, time=1.1, covariance=1e4 * hit.covariance)
    over = replace(hit, time=1.2, value=np.zeros(4))
    assert [sense.look(each).touched for each in (hit, swings, over)] == [True, True, False]


def test_a_touch_ends_and_the_next_one_has_a_time_of_its_own(model):
    sense, hit = TouchSense(model, calibrated()), lacking(model, {20: (0.0, 0.2)})
    said = looked(sense, hit, [0.0, 1.0, 1.0, 0.0, 1.0])
    assert [touch.touched for touch in said] == [False, True, True, False, True]
    assert [30 * touch.since for touch in said if touch.touched] == pytest.approx([1, 1, 4])
    assert said[1].said
    assert not said[3].said


def test_what_was_learned_of_a_touch_that_seemed_over_is_no_touch_when_it_ends(model):
    """At pressures that were never tried, half a force may be a wrong gain, and is learned."""
    sense, hit, said = TouchSense(model), lacking(model, {20: (0.0, 0.2)}), []
    phases = np.repeat([(0.0, 0.5), (1.0, 0.5), (0.5, 2.5), (0.0, 2.5)], [300, 20, 150, 90], axis=0)
    for k, (share, more) in enumerate(phases):
        here, value = more * hit.effective, share * hit.value
        said.append(sense.look(replace(hit, time=k / 30, effective=here, value=value)).touched)
    assert all(said[301:320])
    assert not any(said[321:])


def test_a_stiffness_that_is_wrong_under_gravity_is_no_touch():
    """What a limb lacks of 20 % of its stiffness goes with its bend, not with its pressures."""
    sideways = LIMB.mounted("sideways")
    stiffness = [s.bending_stiffness / s.length / s.moment_gain for s in LIMB.segments]
    found = []
    for limb in (LIMB, sideways):
        sense, still = TouchSense(RodModel(limb)), lacking(RodModel(LIMB), {})
        for k in range(240):
            bend = np.array([0.9, 0.5]) * np.sin(0.01 * k)
            value = np.append(0.2 * bend * stiffness, [0.0, 0.0])
            none = np.zeros(2)
            now = replace(still, time=k / 30, bend_angles=bend, effective=none, value=value)
            found.append(sense.look(now).touched)
    assert any(found[:240])
    assert not any(found[240:])


def test_a_payload_is_weighed_and_what_the_limb_is_driven_against_is_not():
    tilted = RodModel(LIMB.mounted("20"))
    hung = lacking(tilted, {20: 0.06 * np.array(tilted.limb.gravity[:2])})
    sense = TouchSense(tilted, calibrated())
    put_on = looked(sense, hung, np.repeat([0.0, 1.0], [5, 60]))
    assert put_on[8].touched
    assert "or a payload" in put_on[8].said
    assert not put_on[-1].touched
    assert put_on[-1].payload == pytest.approx(0.06, rel=0.1)
    # Friction may have borne a part of it.
    assert not any(touch.touched for touch in looked(sense, hung, np.full(10, 1.2), 2.2))
    taken_off = looked(sense, hung, np.repeat([0.5, 0.0], [10, 20]), 3.0)
    assert not taken_off[-1].touched
    assert taken_off[-1].payload == 0.0
    # A hand comes slowly, though pressures stay.
    shares = np.concatenate([np.linspace(0.0, 2.0, 60), np.full(40, 2.0)])
    hand = looked(TouchSense(tilted, calibrated()), hung, shares)
    assert hand[-1].touched
    assert "or a payload" not in hand[-1].said
    assert hand[-1].payload == 0.0
    # Something fixed takes what the limb is driven with, and pushes as a payload pulls.
    reached = np.concatenate([np.linspace(0.0, 1.0, 20), np.ones(60)])
    fixed = looked(TouchSense(tilted, calibrated()), hung, reached, driven=1.0)
    assert fixed[-1].touched
    assert not any("or a payload" in touch.said for touch in fixed)
    assert fixed[-1].payload == 0.0


def test_a_payload_that_was_weighed_is_known_again():
    tilted = RodModel(LIMB.mounted("20"))
    hung = lacking(tilted, {20: 0.02 * np.array(tilted.limb.gravity[:2])})
    sense = TouchSense(tilted, calibrated())
    shares = np.repeat([0.0, 1.0, 0.0, 1.0], [5, 60, 20, 5])
    felt = looked(sense, hung, shares)
    assert felt[6].touched
    assert felt[64].payload == pytest.approx(0.02, rel=0.1)
    assert felt[84].payload == 0.0
    assert not any(touch.touched for touch in felt[85:])
    assert felt[-1].payload == felt[64].payload


def rubbing() -> RodModel:
    """Return a limb whose friction is worth 900 Pa."""
    friction = {"friction_moment": lambda s: 900.0 * s.moment_gain, "friction_curvature": 0.8}
    return RodModel(with_segments(LIMB, **friction))


def test_friction_that_is_larger_and_less_even_than_said_is_no_touch():
    sense = TouchSense(rubbing())
    for k in range(900):
        turned = np.clip(3.0 * np.sin(0.03 * k + np.array([0.0, 1.0])), -1.0, 1.0)
        value = np.concatenate([-450.0 * turned, [1.2e-3 * turned[0], 8e-4 * turned[1]]])
        found = sense.look(replace(KNOWN, time=k / 30, friction=turned, value=value))
        assert not found.touched
    assert sense.look(replace(KNOWN, time=30.0, value=np.array([900.0, 0.0, 0.0, 0.0]))).touched


def test_friction_of_what_has_slid_holds_less_or_as_much_but_no_harder(model):
    """Both segments have slid to the left, stand still, and may be held by 1 kPa either way."""
    stuck = np.array([[0.0, 0.0], [2000.0, 2000.0]])
    here = replace(KNOWN, stuck=stuck)
    lets_go, held = (
        TouchSense(model, calibrated()).look(replace(here, value=value * np.array([1, 1, 0, 0])))
        for value in (1800.0, -900.0)
    )
    assert not lets_go.touched
    assert held.touched


def test_what_friction_may_hide_of_a_touch_does_not_end_it(model):
    sense, hit = TouchSense(model, calibrated()), lacking(model, {20: (0.0, 0.2)})
    assert sense.look(hit).touched
    hidden = np.stack([np.minimum(hit.value[:2], 0.0), np.maximum(hit.value[:2], 0.0)])
    offset = np.append(hit.value[:2], [0.0, 0.0])
    now = replace(hit, time=1.1, value=offset, stuck=2.0 * hidden)
    assert sense.look(now).touched
    assert not TouchSense(model, calibrated()).look(now).touched


def test_a_light_touch_that_friction_may_hide_is_suspected_until_it_is_over(model):
    sense, hit = TouchSense(model, calibrated()), lacking(model, {20: (0.0, 0.2)})
    felt = sense.look(hit)
    assert felt.suspected
    light = replace(hit, value=np.sqrt(0.4 / felt.distance) * hit.value)
    sense = TouchSense(model, calibrated())
    pressures = light.value[:2]
    one_way = np.stack([np.minimum(pressures, 0.0), np.maximum(pressures, 0.0)])
    # The first could be friction alone; friction bears none of the second, but could bear more.
    hidden, seen = replace(light, stuck=2.0 * one_way), replace(light, stuck=-4.0 * one_way[::-1])
    over = replace(light, value=np.zeros(4))
    said = [
        sense.look(replace(each, time=1.0 + k / 30))
        for k, each in enumerate([over, hidden, light, seen, hidden, over])
    ]
    assert not any(each.touched for each in said)
    assert [each.suspected for each in said] == [False, False, False, True, True, False]


def sliding(sense, time, missing, doubt=40.0, mass=0.0):
    """Feel a limb that bends by 0.1 rad/s, with rates that are hardly known, and lacks pressure.

    Args:
        time: [s].
        missing: effective pressure of the first segment [Pa].
        doubt: its standard deviation [Pa].
        mass: M_w of each segment [Pa s²].
    """
    bend, none = np.full(2, 0.1 * time), np.zeros(2)
    swings = 0.08 * np.cos(40.0 * time)
    at = bend, np.full(2, 0.1), none
    nominal = SimpleNamespace(at=lambda _: at, periods=lambda _: 0, mass=[mass * np.eye(2)])
    mean = np.array([0.0, 0.0, swings, swings, missing, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    deviation = np.append(np.repeat([2e-3, 0.08, doubt, 1e-3, 1e-4], 2), 0.1)
    memory = Memory(bend, np.ones(2), none)
    known = Knowledge(mean, np.diag(deviation**2), none, memory, none, 15_000.0 * bend)
    return sense.feel(time, nominal, known)


def test_a_limb_that_slides_with_another_gain_feels_what_stops_it():
    sense = TouchSense(rubbing())
    for k in range(180):
        assert not sliding(sense, k / 30, -80.0 * k / 30).touched
    pushed = [sliding(sense, k / 30, -80.0 * k / 30 - 900.0) for k in range(180, 186)]
    assert pushed[-1].touched


@pytest.mark.parametrize(("mass", "touched"), [(0.0, True), (1000.0, False)])
def test_what_the_mass_of_a_limb_that_swings_may_take_is_no_touch(mass, touched):
    sense = TouchSense(rubbing())
    for k in range(180):
        sliding(sense, k / 30, 0.0, mass=mass)
    felt = [sliding(sense, k / 30, -700.0, mass=mass) for k in range(180, 186)]
    assert felt[-1].touched is touched


def test_a_surprise_is_a_touch_as_soon_as_the_estimator_knows_what_it_was():
    sense = TouchSense(rubbing())
    for k in range(180):
        sliding(sense, k / 30, 0.0)
    assert not sliding(sense, 6.0, 1200.0, doubt=1000.0).touched
    assert sliding(sense, 6.0 + 1 / 30, 1200.0).touched


@pytest.mark.slow
def test_noise_is_taken_for_a_touch_about_once_in_an_hour(model):
    draw = np.random.default_rng(8)
    sense, spread = TouchSense(model), np.array([700.0, 300.0, 2e-3, 1e-3])
    still = replace(STILL, covariance=1e-6 * np.diag(spread**2))
    for k in range(400):
        value = 0.5 * spread * draw.standard_normal(4)
        sense.look(replace(still, time=0.3 * k, value=value))
    alarms = 0
    for k in range(400, 12400):
        before = sense.newest.touched
        value = 0.5 * spread * draw.standard_normal(4)
        alarms += sense.look(replace(still, time=0.3 * k, value=value)).touched and not before
    assert alarms <= 5


# Reactions -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def touch(model):
    """Something in the way of a limb that bends to the left."""
    return TouchSense(model, calibrated()).look(lacking(model, {15: (0.0, -0.2)}))


CHAMBERS = np.array([6000.0, 3000.0])


def reacted(reaction, wanted, planned, touch, chambers):
    """Return the command in place of a wanted one."""
    reaction.follow(planned, touch, chambers)
    return reaction.allowed(wanted)


def test_yielding_presses_no_harder_than_the_plan(model, touch):
    reaction, less, harder = Reaction(model, "yield"), CHAMBERS - 2000.0, CHAMBERS + 2000.0
    for planned in (CHAMBERS, less):
        kept = reacted(reaction, harder, planned, touch, CHAMBERS)
        assert touch.pressure @ (kept - planned) == pytest.approx(0.0, abs=1e-3)
    np.testing.assert_array_equal(reacted(reaction, less, CHAMBERS, touch, less), less)
    ended = untouched(2.0, touch.bend_angles)
    # Friction may hide what is left of it.
    suspected = replace(ended, suspected=True)
    kept = reacted(reaction, harder, CHAMBERS, suspected, CHAMBERS)
    assert touch.pressure @ (kept - CHAMBERS) == pytest.approx(0.0, abs=1e-3)
    np.testing.assert_array_equal(reacted(reaction, harder, CHAMBERS, ended, less), harder)


@pytest.mark.parametrize("limit", [0.2, 0.4])
def test_a_limit_lets_the_force_come_to_it(model, touch, limit):
    reaction, chambers = Reaction(model, "yield", limit), CHAMBERS
    size = np.linalg.norm(touch.force)
    along = touch.force / size
    deviation = np.sqrt(along @ touch.force_covariance @ along)
    for _ in range(60):
        # What bends the limb as the touch does grows with the force.
        raised = -touch.pressure @ (chambers - CHAMBERS) / (touch.pressure @ touch.pressure)
        grown = (1.0 + raised) * touch.force
        pressed = replace(touch, force=grown, pressure=(1.0 + raised) * touch.pressure)
        chambers = reacted(reaction, CHAMBERS + 9000.0, CHAMBERS + 9000.0, pressed, chambers)
    assert np.linalg.norm(grown) + 2.0 * deviation == pytest.approx(limit, abs=1e-3)


def test_after_a_touch_a_limit_lets_the_limb_come_back_slowly(model, touch):
    reaction, harder = Reaction(model, "yield", 0.1), CHAMBERS + 9000.0
    kept = reacted(reaction, harder, harder, touch, CHAMBERS)
    ended = untouched(2.0, touch.bend_angles)
    pressing = -touch.pressure / np.linalg.norm(touch.pressure)
    # Slower while friction may hide what is left of it.
    back = reacted(reaction, harder, harder, replace(ended, suspected=True), kept)
    np.testing.assert_allclose(back - kept, 25.0 * pressing, atol=1e-6)
    kept = back
    for _ in range(200):
        before, kept = kept, reacted(reaction, harder, harder, ended, kept)
        assert pressing @ (kept - before) < 100.0 or np.array_equal(kept, harder)
    np.testing.assert_array_equal(kept, harder)


def test_a_limit_lets_go_slowly_until_the_force_is_told(model, touch):
    reaction, kept = Reaction(model, "yield", 0.4), CHAMBERS
    untold = replace(touch, force=np.full(2, np.nan))
    pressing = -touch.pressure / np.linalg.norm(touch.pressure)
    for k in range(1, 11):
        kept = reacted(reaction, CHAMBERS + 9000.0, CHAMBERS, untold, kept)
        # Across it pressures stay.
        np.testing.assert_allclose(CHAMBERS - kept, 75.0 * k * pressing, atol=1e-6)
    back = reacted(reaction, CHAMBERS - 4000.0, CHAMBERS, untold, kept)
    assert pressing @ (back - kept) < 0.0
    for _ in range(1000):
        kept = reacted(reaction, CHAMBERS + 9000.0, CHAMBERS, untold, kept)
    # Vented chambers press no more.
    assert pressing @ kept == pytest.approx(0.0, abs=1e-6)


def test_holding_and_venting_keep_what_the_chambers_had(model, touch):
    wanted = CHAMBERS + 2000.0
    for kind in ("hold", "vent"):
        reaction = Reaction(model, kind)
        for now, time in ((CHAMBERS, 1.0), (0.5 * CHAMBERS, 1.03)):
            assert not reaction.vents  # by one picture
            kept = reacted(reaction, wanted, CHAMBERS, replace(touch, time=time), now)
            np.testing.assert_array_equal(kept, CHAMBERS)
        assert reaction.vents == (kind == "vent")
    unchanged = reacted(Reaction(model, "warn"), wanted, CHAMBERS, touch, CHAMBERS)
    np.testing.assert_array_equal(unchanged, wanted)


def test_corrections_stay_while_something_touches_and_come_back_slowly(model, touch):
    reaction, first = Reaction(model, "yield"), np.array([500.0, -200.0])
    np.testing.assert_array_equal(reaction.corrected(first), first)
    reaction.follow(CHAMBERS, touch, CHAMBERS)
    for _ in range(40):
        np.testing.assert_array_equal(reaction.corrected(first + 3000.0), first)
    reaction.follow(CHAMBERS, untouched(3.0, np.zeros(2)), CHAMBERS)
    came = [reaction.corrected(first + 3000.0)[0] for _ in range(80)]
    assert np.all(np.diff(came) > 0.0)
    assert came[-1] == pytest.approx(3500.0)
    # Touched again on the way back, they stay where they are: a jump would make the limb swing.
    reaction.follow(CHAMBERS, touch, CHAMBERS)
    reaction.corrected(first)
    reaction.follow(CHAMBERS, untouched(4.0, np.zeros(2)), CHAMBERS)
    for _ in range(40):
        halfway = reaction.corrected(first + 3000.0)
    reaction.follow(CHAMBERS, touch, CHAMBERS)
    np.testing.assert_array_equal(reaction.corrected(first + 3000.0), halfway)


def test_corrections_shrink_but_do_not_grow_while_a_touch_is_suspected(model):
    reaction, first = Reaction(model, "yield"), np.array([500.0, -200.0])
    reaction.corrected(first)
    suspected = replace(untouched(1.0, np.zeros(2)), suspected=True)
    reaction.follow(CHAMBERS, suspected, CHAMBERS)
    np.testing.assert_array_equal(reaction.corrected(3.0 * first), first)
    np.testing.assert_array_equal(reaction.corrected(0.5 * first), 0.5 * first)
    np.testing.assert_array_equal(reaction.corrected(first), 0.5 * first)
    np.testing.assert_array_equal(reaction.corrected(-first), 0.0 * first)
    reaction.follow(CHAMBERS, untouched(2.0, np.zeros(2)), CHAMBERS)
    np.testing.assert_array_equal(reaction.corrected(first), first)
    warns = Reaction(model, "warn")
    warns.follow(CHAMBERS, suspected, CHAMBERS)
    np.testing.assert_array_equal(warns.corrected(first), first)


def test_what_is_no_reaction_is_refused(model):
    with pytest.raises(ValueError, match="warn, hold, yield, vent"):
        Reaction(model, "flee")
    with pytest.raises(ValueError, match="0 N or more"):
        Reaction(model, "yield", -1.0)
    with pytest.raises(ValueError, match="with the reaction yield"):
        Reaction(model, "hold", 0.5)
