"""How a rig is put together: found on the twin for every wiring, refused where it contradicts."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from der_planner.identification.rig import RigError, RigLog, check_run, find_rig
from der_planner.model import CONTROL_PERIOD
from der_planner.twin.offline import OfflineTwin
from der_planner.twin.wiring import Wiring

ARCS = np.array([0.010, 0.061, 0.122, 0.183, 0.239])
NAMES = ("a", "b", "c", "d", "e")
LENGTHS = (0.122, 0.122)
FILL_ROWS = 140
"""Rows from one fill to the next."""
BEFORE = 12
"""Rows before a fill that belong to it."""


def record(seed: int) -> RigLog:
    """Play a check on the twin, in simulated time."""
    run, limb = check_run(2, 3_000.0), OfflineTwin(seed)
    random = np.random.default_rng(seed)
    measured, places = [], []
    for command in run.differential_pressure:
        measured.append(limb.pneumatics.pressure + 5.0 * random.standard_normal(4))
        shape = limb.twin.shape()
        x, y = (np.interp(ARCS, shape.arc_length, shape.points[:, k]) for k in (0, 1))
        heading = np.interp(ARCS, shape.arc_length, shape.heading)
        noise = random.standard_normal((len(ARCS), 3)) * [1e-4, 1e-4, 2e-3]
        places.append(np.column_stack([x, y, heading]) + noise)
        limb.advance(command, CONTROL_PERIOD)
    return RigLog(
        time=run.time,
        command=run.differential_pressure,
        measured=np.array(measured),
        opening=np.full((len(run.time), 4), np.nan),
        seen_time=run.time,
        places=np.array(places),
        names=NAMES,
        arc_lengths=ARCS,
        segment_lengths=LENGTHS,
    )


@pytest.fixture(scope="module")
def straight() -> RigLog:
    return record(seed=3)


def rows_of(fill: int) -> slice:
    start = 40 + FILL_ROWS * fill
    return slice(start - BEFORE, start - BEFORE + FILL_ROWS)


def wired(wiring: Wiring, straight: RigLog) -> RigLog:
    """Put the log of any wiring together from the motions of single chambers."""
    places = straight.places.copy()
    rest = straight.places[:20].mean(axis=0)
    for valve, chamber in enumerate(wiring.chambers):
        side = np.sign(chamber)  # a chamber that bends the other way mirrors the motion
        rows = straight.places[rows_of(abs(chamber) - 1)] * [1, side, side]
        target = places[rows_of(valve)]
        target[:] = (rest + rows - rows[:BEFORE].mean(axis=0))[: len(target)]
    return dataclasses.replace(straight, places=places)


@pytest.mark.slow
def test_all_384_wirings_are_found_and_those_that_contradict_themselves_refused(straight):
    orders, sides = itertools.permutations((1, 2, 3, 4)), itertools.product((1, -1), repeat=4)
    wirings = [
        Wiring(tuple(side * chamber for side, chamber in zip(signs, order, strict=True)))
        for order, signs in itertools.product(orders, sides)
    ]
    assert len(wirings) == 384
    playable = 0
    for wiring in wirings:
        found = find_rig(wired(wiring, straight))
        assert [(v.segment, v.side) for v in found.valves] == list(wiring.moves), wiring
        assert [v.sensor for v in found.valves] == [0, 1, 2, 3]
        assert min(v.sure for v in found.valves) > 0.5
        if len(set(wiring.moves)) == 4:
            playable += 1
            assert not found.contradictions
            chambers = [2 * segment + (side < 0) for segment, side in wiring.moves]
            assert [chambers[valve] for valve in found.wiring] == [0, 1, 2, 3]
        else:
            assert any("both bend segment" in each for each in found.contradictions)
            with pytest.raises(RigError, match="wrong port"):
                _ = found.wiring
    assert playable == 96


def test_a_wiring_fills_the_chambers_that_bend_alike():
    felt = Wiring((2, -1, -4, 3)).felt([101e3, 102e3, 103e3, 104e3], atmosphere=100e3)
    np.testing.assert_array_equal(felt, [100e3, 103e3, 107e3, 100e3])


@pytest.mark.slow
def test_lags_and_rises_are_those_of_the_twin(straight):
    found = find_rig(straight)
    assert found.wiring == (0, 1, 2, 3)
    assert not found.warnings
    assert found.order == (0, 1, 2, 3, 4)
    for each in found.valves:
        assert each.rise == pytest.approx(3000.0, rel=0.05)
        # The dead time of a valve, and 0.1 of 3 kPa at 9 kPa/s.
        assert 0.03 < each.to_pressure < 0.15
        assert -0.05 < each.to_motion < 0.4


@pytest.mark.slow
def test_a_sensor_that_errs_is_no_leak_of_a_weak_limb(straight):
    """An eighth of 4 kPa is 500 Pa: sensors err by up to half of it, a leak leaves more missing."""
    rest = straight.measured[:20].mean(axis=0)
    for missing, leaks in ((240.0, False), (350.0, True)):
        measured = rest + (1.0 - missing / 500.0) / 6.0 * (straight.measured - rest)
        weak = dataclasses.replace(straight, command=straight.command / 6.0, measured=measured)
        found = find_rig(weak)
        assert any("it leaks" in each for each in found.warnings) == leaks


@pytest.mark.slow
def test_what_is_broken_is_named(straight):
    dead, still = straight.measured.copy(), straight.places.copy()
    rows = rows_of(1)
    dead[rows] = dead[:20].mean(axis=0)
    still[rows] = still[rows.start : rows.start + BEFORE].mean(axis=0)
    found = find_rig(dataclasses.replace(straight, measured=dead, places=still))
    assert any("valve 2: dead" in each for each in found.contradictions)

    found = find_rig(dataclasses.replace(straight, places=still))
    assert any("valve 2: pressure but no motion" in each for each in found.contradictions)
    assert "no valve bends segment 0 to the right" in found.contradictions

    found = find_rig(dataclasses.replace(straight, measured=dead))
    assert any("valve 2: motion but no pressure" in each for each in found.warnings)

    leaking = straight.measured.copy()
    rest = leaking[:20, 2].mean()
    leaking[:, 2] = rest + 0.8 * (leaking[:, 2] - rest)
    untold = np.full_like(straight.opening, np.nan)
    found = find_rig(dataclasses.replace(straight, measured=leaking, opening=untold))
    (said,) = found.warnings
    assert "valve 3: it leaks" in said
    assert "nan" not in said
    assert not found.contradictions

    opening = np.where(np.abs(straight.command[:, [0, 0, 1, 1]]) > 0, 0.3, 0.0)
    found = find_rig(dataclasses.replace(straight, opening=opening))
    assert any("its inlet is 27 % open" in each for each in found.warnings)

    crossed = straight.measured[:, [1, 0, 2, 3]]
    found = find_rig(dataclasses.replace(straight, measured=crossed))
    assert any("sensor 1 reads valve 2" in each for each in found.warnings)

    joined = straight.places.copy()
    joined[rows_of(0)] += joined[rows_of(2)] - joined[rows_of(2)][:BEFORE].mean(axis=0)
    found = find_rig(dataclasses.replace(straight, places=joined))
    assert any("more than one segment bends" in each for each in found.contradictions)


@pytest.mark.slow
def test_bodies_in_another_order_than_the_map_says_are_named(straight):
    places = straight.places[:, [0, 3, 2, 1, 4]]
    found = find_rig(dataclasses.replace(straight, places=places))
    assert [NAMES[k] for k in found.order] == ["a", "d", "c", "b", "e"]
    assert found.order_ratio > 1.2
    assert any(
        "along the limb are a, d, c, b, e, and in the map a, b, c, d, e" in each
        for each in found.contradictions
    )
    # What moves what is found all the same.
    assert [(v.segment, v.side) for v in found.valves] == [(0, 1), (0, -1), (1, 1), (1, -1)]


@pytest.mark.slow
def test_logs_that_tell_nothing_are_refused(straight):
    command = straight.command.copy()
    command[40 + 3 * FILL_ROWS :] = 0.0
    for changes, said in (
        ({"command": command}, "valve 4 was not filled"),
        ({"command": 0 * command}, "no log of a check"),
        ({"places": np.full_like(straight.places, np.nan)}, "nothing was seen"),
        ({"arc_lengths": np.array([0.01, 0.02, 0.03, 0.2, 0.239])}, "half of segment 0"),
    ):
        with pytest.raises(RigError, match=said):
            find_rig(dataclasses.replace(straight, **changes))
