"""Drawn limbs that are calibrated: what is drawn, and that a study goes on where it was stopped."""

from dataclasses import replace

import numpy as np

from benchmarks import rows
from benchmarks.draws import calibration
from der_planner.planning.loads.rest import rest_of


def test_every_mounting_gets_every_kind_of_limb_that_can_be_in_it():
    drawn = [calibration.wanted(number) for number in range(calibration.LIMBS)]
    pairs = {(row.mounting, row.kind) for row in drawn}
    for mounting in calibration.MOUNTINGS:
        kinds = {"rod"} if mounting == "standing" else set(calibration.KINDS)
        assert {kind for at, kind in pairs if at == mounting} == kinds


def test_a_drawn_limb_rests_where_it_is_mounted():
    limb = calibration.drawn_rod(np.random.default_rng(3), "standing")
    assert limb.gravity[0] < 0
    rest_of(limb)
    other = calibration.drawn_rod(np.random.default_rng(4), "standing")
    assert other.segments[0].bending_stiffness != limb.segments[0].bending_stiffness


def test_rows_are_read_as_they_were_written(tmp_path):
    row = replace(
        calibration.wanted(7), outcome="refused", said='a "b", c\nd', fit_deg=0.25, commit="1"
    )
    path = tmp_path / "rows.csv"
    assert rows.read(calibration.Row, path) == []
    rows.append(row, path)
    rows.append(replace(row, number=8), path)
    found = rows.read(calibration.Row, path)
    assert [each.number for each in found] == [7, 8]
    assert (found[0].said, found[0].fit_deg, found[0].commit) == (row.said, 0.25, "1")
    assert np.isnan(found[0].cpu_s)
