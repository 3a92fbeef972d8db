"""A limb file brought up to date from ordinary runs, with what they tell and no more."""

from dataclasses import replace

import numpy as np
import pytest
from limbs import with_segments
from log_table import write_csv

from der_planner.commands import check_limb
from der_planner.identification import CalibrationLog, LogError, update
from der_planner.limb import Limb
from der_planner.model import simulate

LIMB = Limb.default()
RUBBING = with_segments(
    LIMB,
    friction_moment=lambda s: 300.0 * s.moment_gain,
    friction_curvature=lambda s: 0.1 / s.length,
)


def another_day(limb, gain=(1.0, 1.0), rest=(0.0, 0.0), friction=(1.0, 1.0)):
    """Return a limb whose gains, rest angles [rad] and frictions have changed."""
    return with_segments(
        limb,
        moment_gain=[s.moment_gain * g for s, g in zip(limb.segments, gain, strict=True)],
        rest_curvature=[
            s.rest_curvature + r / s.length for s, r in zip(limb.segments, rest, strict=True)
        ],
        friction_moment=[
            s.friction_moment * f for s, f in zip(limb.segments, friction, strict=True)
        ],
    )


def motion(duration=20.0, moves=(1.0, 1.0)):
    """Return instants [s] and pressures (K, 2) [Pa] of slow waves from rest."""
    time = np.arange(0.0, duration, 0.05)
    waves = [8000.0 * np.sin(time / 1.9), 7000.0 * np.sin(time / 1.3)]
    return time, np.stack(waves, axis=1) * np.minimum(time / 3.0, 1.0)[:, None] * moves


def filmed(limb, time, pressure, source="run"):
    """Return the log of a run of a limb, with the tags' noise."""
    seen = simulate(limb, time, pressures=pressure)
    noise = np.deg2rad(0.1) * np.random.default_rng(1).standard_normal(pressure.shape)
    return CalibrationLog(time, pressure, pressure, seen.bend_angles + noise, seen.tip, source)


def numbers(limb):
    return np.array([[s.moment_gain, s.rest_curvature, s.friction_moment] for s in limb.segments])


def test_gain_rest_angle_and_friction_of_another_day_are_found():
    today = another_day(RUBBING, (0.6, 1.4), (0.08, -0.1), (1.8, 0.5))
    found, said = update(RUBBING, filmed(today, *motion()))
    assert numbers(found)[:, 0] == pytest.approx(numbers(today)[:, 0], rel=0.02)
    assert np.ptp(numbers(found)[:, 1] - numbers(today)[:, 1]) * 0.122 < np.deg2rad(0.5)
    assert numbers(found)[:, 2] == pytest.approx(numbers(today)[:, 2], rel=0.3)
    assert np.degrees(said.error_before).min() > 4.0
    assert np.degrees(said.error_after).max() < 0.3
    assert all(change.told and change.deviation < change.term.spread for change in said.changes)
    distance = [
        abs(c.after - n) / c.deviation for c, n in zip(said.changes, days(today), strict=True)
    ]
    assert max(distance) < 5.0, distance
    assert "gain" in said.text()
    assert found.provenance["update"]["source"] == ["run"]


def days(limb):
    for s in limb.segments:
        yield s.moment_gain * s.length / s.bending_stiffness
        yield s.rest_curvature * s.length
        yield s.friction_moment / s.moment_gain


def test_what_a_run_does_not_tell_stays():
    today = another_day(RUBBING, (0.7, 0.7))
    found, said = update(RUBBING, filmed(today, *motion(moves=(1.0, 0.0))))
    told = {(c.segment, c.term.name): c.told for c in said.changes}
    assert told[0, "gain"]
    assert not told[1, "gain"]
    assert not told[1, "friction_pressure"]
    assert numbers(found)[0, 0] == pytest.approx(0.7 * numbers(RUBBING)[0, 0], rel=0.02)
    assert numbers(found)[1, 0] == numbers(RUBBING)[1, 0]
    assert numbers(found)[1, 2] == numbers(RUBBING)[1, 2]
    assert "segment 1, gain" in said.text()
    assert "stays" in said.text()


def test_a_run_to_one_side_says_that_it_does_not_tell_the_other():
    time, pressure = motion()
    pressure[:, 0] = np.abs(pressure[:, 0])
    today = another_day(RUBBING, (0.7, 0.7))
    _, said = update(RUBBING, filmed(today, time, pressure))
    assert [text for text in said.warnings if "one side only" in text] == [said.warnings[-1]]
    assert said.warnings[-1].startswith("segment 0")


def test_the_arcs_change_alike():
    arcs = tuple(replace(s, moment_gain=1.1 * s.moment_gain) for s in RUBBING.segments)
    today = another_day(RUBBING, (0.6, 1.4))
    found, _ = update(replace(RUBBING, pcc_segments=arcs), filmed(today, *motion()))
    pairs = zip(found.pcc_segments, found.segments, strict=True)
    assert [a.moment_gain / s.moment_gain for a, s in pairs] == pytest.approx([1.1, 1.1])


def test_another_limb_and_runs_too_short_are_refused():
    time, pressure = motion()
    log = filmed(RUBBING, time, pressure)
    with pytest.raises(LogError, match="segment 0 bends the wrong way"):
        update(RUBBING, replace(log, bend_angles=-log.bend_angles))
    with pytest.raises(LogError, match="segment 0 bends with input 1"):
        update(RUBBING, replace(log, bend_angles=log.bend_angles[:, ::-1]))
    leaking = np.where([True, False], np.maximum(log.bend_angles, 0.0), log.bend_angles)
    with pytest.raises(LogError, match="segment 0 bends to the right by 0 %"):
        update(RUBBING, replace(log, bend_angles=leaking))
    with pytest.raises(LogError, match=r"the runs last 3\.0 s"):
        update(RUBBING, log.between(0.0, 3.0))
    with pytest.raises(LogError, match="belongs to another limb"):
        update(replace(RUBBING, segments=RUBBING.segments[:1]), log)


def test_what_gain_rest_and_friction_do_not_explain_asks_for_a_calibration():
    time, pressure = motion()
    log = filmed(RUBBING, time, pressure)
    strange = log.bend_angles + 0.2 * np.sign(np.sin(3.0 * time))[:, None]
    _, said = update(RUBBING, replace(log, bend_angles=strange))
    assert not said.enough
    assert "calibrate again" in said.text()
    _, other = update(another_day(RUBBING, (0.1, 1.0)), log)
    assert not other.enough


def test_the_command_writes_a_new_file_and_never_the_old_one(tmp_path, call):
    changed = another_day(RUBBING, (0.6, 1.4), (0.05, -0.05))
    log, today = filmed(changed, *motion()), numbers(changed)
    old, new = tmp_path / "limb.yaml", tmp_path / "today.yaml"
    RUBBING.to_yaml(old)
    write_csv(log.between(0.0, 15.0), tmp_path / "log.csv", tmp_path / "columns.yaml")
    before = old.read_bytes()
    columns = ("--columns", tmp_path / "columns.yaml")
    given = (*columns, "--limb", old)

    assert call(check_limb, tmp_path / "log.csv", *given)[0] == 3
    code, said, _ = call(check_limb, "--update", tmp_path / "log.csv", *given)
    assert code == 0
    assert "nothing was written" in said
    assert call(check_limb, "--update", tmp_path / "log.csv", *given, "--out", old)[0] == 2
    assert old.read_bytes() == before
    assert call(check_limb, "--update", tmp_path / "log.csv", *given, "--out", new)[0] == 0
    assert numbers(Limb.from_yaml(new))[:, 0] == pytest.approx(today[:, 0], rel=0.03)
    assert (
        call(
            check_limb, tmp_path / "log.csv", "--columns", tmp_path / "columns.yaml", "--limb", new
        )[0]
        == 0
    )
