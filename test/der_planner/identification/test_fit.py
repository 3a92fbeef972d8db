"""Fits on logs whose truth is known, and logs that must be refused."""

import weakref
from dataclasses import replace

import numpy as np
import pytest
from limbs import of_pressures, with_segments

from der_planner.estimation.free_level import FreeLevel
from der_planner.identification import CalibrationLog, LogError, check, fit, predict
from der_planner.identification.bends import NODES, BendFit, Predicted, follow
from der_planner.identification.excitation import calibration_run, steps, sweep, waves
from der_planner.identification.lengths import fit_geometry, lengths_of, with_lengths
from der_planner.identification.log import Prepared, prepare
from der_planner.identification.terms import COLUMN, TERMS, FreeTerms, values_of
from der_planner.limb import Limb
from der_planner.model import Material, RodModel

pytestmark = pytest.mark.slow

NOISE = np.deg2rad(0.1)
STATIC = ("gain", "rest_angle", "gain_asymmetry", "pressure_stiffening", "cubic")
# Swings loosen friction, which `predict` leaves out: so that it hardly swings.
DAMPED = with_segments(Limb.default(), damping=8.0)


def hidden_limb() -> Limb:
    gain = DAMPED.segments[0].moment_gain
    limb = with_segments(
        DAMPED,
        moment_gain=[1.12 * gain, 0.9 * gain],
        rest_curvature=[0.35, -0.25],
        gain_asymmetry=[0.04, -0.03],
        pressure_stiffening=4e-6,
        creep_time=9.0,
        coupling_before=0.03,
        coupling_after=-0.02,
        bending_stiffness=0.0175,
    )
    return with_segments(
        limb,
        friction_moment=lambda s: 300 * s.moment_gain,
        friction_curvature=lambda s: 0.12 / s.length,
        creep_stiffness=lambda s: 400 * s.moment_gain * s.length,
        cubic_stiffness=lambda s: 0.06 * s.bending_stiffness * s.length**2,
    )


def synthetic_log(limb: Limb, seed: int = 0, slow: bool = False) -> CalibrationLog:
    pressure = waves(14_000.0, 2, 40.0)
    if not slow:
        pressure = np.concatenate([pressure, steps(5000.0), sweep(3500.0, 2, 12.0)])
    time = 0.05 * np.arange(len(pressure))
    generator = np.random.default_rng(seed)
    # a chamber is never as steep as its command
    held = np.stack([np.convolve(c, np.ones(8) / 8, "full")[: len(time)] for c in pressure.T], 1)
    predicted = predict(limb, time, held)
    return CalibrationLog(
        time=time,
        commanded_differential=pressure,
        measured_differential=held + 5.0 * generator.standard_normal(held.shape),
        bend_angles=predicted.bend_angles + NOISE * generator.standard_normal(held.shape),
        tip=predicted.tip + 3e-4 * generator.standard_normal((len(time), 2)),
        source="synthetic",
    )


@pytest.fixture(scope="module")
def log() -> CalibrationLog:
    return synthetic_log(hidden_limb())


@pytest.fixture(scope="module")
def fitted(log):
    return fit(DAMPED, log)


def test_derivatives_agree_with_differences(log):
    log = log.between(0.0, 15.0)
    prepared = Prepared(
        log, log.measured_differential, log.bend_angles, np.ones(len(log.time), bool), ()
    )
    names = {term.name for term in TERMS} - {"material_damping"}  # zero is its lower bound
    free = FreeTerms.of(hidden_limb(), names)
    values = free.unknowns.prior
    exact = Predicted(free, RodModel(free.limb, NODES), prepared, values).by[0]
    for place, term in enumerate(free.terms):
        step = 1e-4 * term.scale * np.eye(len(values))[place]
        ends = [
            follow(RodModel(free.limb_with(values + sign * step), NODES), prepared).bend_angles
            for sign in (1, -1)
        ]
        difference = (ends[0] - ends[1]) / (2 * step[place])
        scale = np.abs(difference).max()
        # What is no pressure goes through a coarse difference, and a rest angle bends the start
        # too; a cubic term acts where the rod bends, its derivative evenly over the segment.
        tolerance = {"dynamics": 0.2, "mass": 0.2, "cubic": 0.05}.get(term.group, 0.02)
        assert np.abs(exact[:, :, place] - difference).max() < tolerance * scale, term.name


def test_a_fit_is_gone_with_its_last_reader(log):
    free = FreeTerms.of(hidden_limb(), {"gain"})
    problem = BendFit(free, RodModel(free.limb, NODES), [prepare(log, free.limb)])
    assert problem.search.follows(free.unknowns.prior)
    gone = weakref.ref(problem)
    del problem
    assert gone() is None  # its predictions are hundreds of megabytes


def test_a_swing_lets_go_of_friction_while_a_segment_waits():
    limb = with_segments(
        Limb.default(),
        friction_moment=lambda s: 800.0 * s.moment_gain,
        friction_curvature=lambda s: 0.12 / s.length,
    )
    model, time = RodModel(limb, NODES), 0.05 * np.arange(300)
    pressure = np.outer(np.clip(time / 3.0, 0.0, 1.0), [9000.0, -9000.0])
    bend = Material(limb).resting_bend(time, pressure)
    log = CalibrationLog(time, pressure, pressure, bend, np.full((300, 2), np.nan))
    swing = 0.06 * np.sin(9.0 * time) * np.exp(-((time - 9.0) ** 2) / 4.0)
    still = Prepared(log, pressure, bend, np.ones(300, bool), ())
    shaken = replace(still, bend=bend + swing[:, None])
    stays, freed, unmoved = (
        follow(model, each).bend_angles[-1]
        for each in (still, shaken, replace(shaken, swings=False))
    )
    np.testing.assert_allclose(unmoved, stays, atol=2e-3)
    held = 800.0 * limb.static_gain
    assert np.all(np.abs(freed - stays) > 0.6 * held)
    assert np.all(np.abs(freed - stays) < 1.1 * held)


def test_known_parameters_are_recovered_within_their_uncertainty(fitted):
    _, report = fitted
    truth = values_of(hidden_limb())
    for segment in range(2):
        for name in STATIC + (("coupling_after",), ("coupling_before",))[segment]:
            item = report.value(f"{name}[{segment}]")
            true = truth[segment, COLUMN[name]]
            spread = max(item.deviation, 1e-3 * abs(true))
            assert abs(item.value - true) < 4 * spread, (name, item, true)
    assert np.degrees(report.residual).max() < 0.4
    assert report.value("gain[0]").deviation < 0.03 * report.value("gain[0]").value


@pytest.mark.parametrize("factor", [0.2, 12.0])
def test_a_limb_of_other_pressures_is_found_alike(log, fitted, factor):
    pressures = {
        key: factor * getattr(log, key)
        for key in ("commanded_differential", "measured_differential")
    }
    limb, report = fit(of_pressures(DAMPED, factor), replace(log, **pressures))
    expected = values_of(of_pressures(fitted[0], factor))
    np.testing.assert_allclose(values_of(limb), expected, rtol=0.01, atol=1e-3)
    assert report.residual == pytest.approx(fitted[1].residual, rel=1e-3)
    assert report.warnings == fitted[1].warnings


def test_a_log_tells_what_the_model_lacks_of_a_free_limb(fitted):
    limb, _ = fitted
    bare = replace(limb, calibrated=replace(limb.calibrated, free_level=""))
    told, first = (np.array(FreeLevel(each).told().split(), float) for each in (limb, bare))
    places, deviations = np.arange(24).reshape(4, 6), np.arange(24, 48).reshape(4, 6)
    by_pressure = places[:2, :2], deviations[:2, :2]
    assert np.abs(told[by_pressure[0]]).max() < 0.02
    assert np.all(told[by_pressure[1]] < 0.5 * first[by_pressure[1]])


def test_a_limb_that_fits_passes_the_check_and_a_changed_one_does_not(fitted):
    limb, _ = fitted
    log = synthetic_log(hidden_limb(), seed=5, slow=True)
    assert check(limb, log).fits
    short = check(limb, replace(log, commanded_differential=log.commanded_differential + 1500.0))
    assert short.fits
    by_pressures, by_commands = short.tip_error
    assert by_commands > 5.0 * by_pressures
    drifted = hidden_limb()
    gains = [share * s.moment_gain for share, s in zip((0.8, 1.0), drifted.segments, strict=True)]
    verdict = check(limb, synthetic_log(with_segments(drifted, moment_gain=gains), slow=True))
    assert not verdict.fits
    assert any("gain of segment 0" in finding for finding in verdict.findings)
    assert not any("gain of segment 1" in finding for finding in verdict.findings)


def test_lengths_are_recovered_from_tips():
    limb = with_lengths(Limb.default(), np.array([0.1195, 0.1235, 5e-3, 6e-3]))
    generator = np.random.default_rng(2)
    angles = generator.uniform(-0.8, 0.8, (400, 2))
    tip = RodModel(limb).kinematics.tip(angles)
    tip += 2e-4 * generator.standard_normal(tip.shape)
    time, none = 0.05 * np.arange(400), np.zeros((400, 2))
    found = fit_geometry(Limb.default(), CalibrationLog(time, none, none, angles, tip))
    assert found is not None
    error = lengths_of(found.limb) - [0.1195, 0.1235, 5e-3, 6e-3]
    assert np.all(np.abs(error) < 3 * found.uncertainty)
    assert found.residual < 0.4e-3 < found.residual_before


def test_a_slow_log_does_not_tell_stiffness_from_gain():
    time = 0.05 * np.arange(2400)
    pressure = 5000 * np.stack([1 - np.cos(time / 15), np.cos(time / 11) - 1], axis=1)
    predicted = predict(Limb.default(), time, pressure)
    noise = NOISE * np.random.default_rng(0).standard_normal(pressure.shape)
    slow = CalibrationLog(time, pressure, pressure, predicted.bend_angles + noise, predicted.tip)
    limb, report = fit(Limb.default(), slow, terms=("dynamics",))
    assert any("too slow" in warning for warning in report.warnings)
    assert limb.segments[0].bending_stiffness == Limb.default().segments[0].bending_stiffness


def test_bad_logs_are_refused_by_what_is_wrong(log):
    limb, u, q = Limb.default(), log.measured_differential, log.bend_angles
    still = u.copy()
    still[:, 1] = 0.0
    blind = q.copy()
    blind[: int(0.7 * len(q))] = np.nan
    cases = {
        "input 1 was not excited": replace(
            log, measured_differential=still, commanded_differential=still
        ),
        "tags were seen": replace(log, bend_angles=blind),
        "swapped": replace(log, bend_angles=q[:, ::-1]),
        "wrong way": replace(log, bend_angles=-q),
        "follow its command": replace(log, commanded_differential=u[::-1].copy()),
        "pressure_unit": replace(log, measured_differential=u * 1e-4),
        "or give your limb's limit": replace(log, measured_differential=u * 6.9),
    }
    for match, bad in cases.items():
        with pytest.raises(LogError, match=match):
            fit(limb, bad)
    one = replace(limb, segments=limb.segments[:1])
    with pytest.raises(LogError, match="another limb"):
        fit(one, log)
    with pytest.raises(LogError, match="unknown model term"):
        fit(limb, log, terms=("magic",))


def test_a_fit_that_misses_its_log_says_so(log):
    other = replace(log, bend_angles=np.roll(log.bend_angles, 20, axis=0))
    _, report = fit(Limb.default(), other, terms=())
    assert any("do angles and pressures have one clock?" in said for said in report.warnings)


def test_excitation_stays_inside_its_amplitude_and_excites_each_input_alone():
    run = calibration_run(10_000.0)
    assert np.abs(run.differential_pressure).max() <= 10_000.0
    assert 150 < run.duration < 240
    assert calibration_run(10_000.0, quick=True).duration < 0.5 * run.duration
    assert abs(np.corrcoef(run.differential_pressure.T)[0, 1]) < 0.5
    np.testing.assert_array_equal(run.differential_pressure[[0, -1]], 0.0)


def test_what_is_seen_late_is_told_and_taken_out_of_the_fit(fitted):
    _, report = fitted
    late, deviation = report.delay
    assert abs(late) < max(4.0 * deviation, 0.004)
    assert report.taken_out == 0.0
    log = synthetic_log(Limb.default()).between(40.0, 68.0)
    late = replace(log, bend_angles=log.seen_earlier(-0.03).bend_angles)
    _, told = fit(Limb.default(), late, terms=["dynamics"])
    assert told.delay[0] == pytest.approx(0.03, abs=0.004)
    assert abs(told.delay[0] - told.taken_out) < max(4.0 * told.delay[1], 0.002)
    assert abs(told.value("log_damping").value) < 0.5


def test_a_small_lead_is_told_and_stays_since_no_camera_leads():
    log = synthetic_log(Limb.default()).between(40.0, 68.0)
    for lead, taken_out in ((0.05, 0.0), (0.25, -0.25)):
        early = replace(log, bend_angles=log.seen_earlier(lead).bend_angles)
        _, told = fit(Limb.default(), early, terms=["dynamics"])
        assert told.taken_out == pytest.approx(taken_out, rel=0.4)
        assert "early, as no camera is" in told.text()


def test_a_number_at_the_end_of_its_range_names_what_would_tell_it():
    sticking = with_segments(
        Limb.default(),
        friction_moment=lambda s: 800.0 * s.moment_gain,
        friction_curvature=lambda s: 0.003 / s.length,
    )
    _, report = fit(Limb.default(), synthetic_log(sticking), terms=("friction", "dynamics"))
    said = [warning for warning in report.warnings if "at the end of its range" in warning]
    assert any("friction_angle[0]" in warning for warning in said)
    assert all("slow strokes of a few degrees" in w for w in said if "friction" in w)


def test_stiffness_that_the_log_hardly_tells_stays_where_the_model_misses_the_log():
    """Slow errors of the model must not move what only fast motion would tell."""
    log = synthetic_log(hidden_limb(), slow=True)
    strange = np.deg2rad(2.0) * np.sign(np.sin(log.time[:, None] * [0.9, 0.7]))
    prior = Limb.default()
    limb, report = fit(
        prior, replace(log, bend_angles=log.bend_angles + strange), terms=("friction", "dynamics")
    )
    assert any("tells the stiffness of segment 1" in warning for warning in report.warnings)
    kept = report.value("log_stiffness[1]")
    assert kept.untold
    assert (kept.value, kept.deviation) == (0.0, 0.3)
    assert limb.segments[1].bending_stiffness == prior.segments[1].bending_stiffness
