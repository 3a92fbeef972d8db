"""What feedback did in a run: how soon the board knew, and ways of playing side by side."""

from dataclasses import replace

import numpy as np
from runs import FRAMES, reference, series

from der_planner.bags.record import Revisions
from der_planner.bags.series import described, latencies
from der_planner.results import evaluate_run
from der_planner.results.report import side_by_side_table
from der_planner.results.statistics import control_of, side_by_side

MS = 1_000_000


def test_a_picture_counts_until_the_first_setpoint_that_knows_of_it():
    revisions = Revisions()
    # Setpoints every 50 ms, each revised twice; an estimate tells which picture a revision knew.
    for k, (stamp, picture) in enumerate([(100, 10), (150, 43), (150, 76), (200, 110)]):
        added = np.array([10.0 + k, 3.0])
        revisions.revised(stamp * MS, added)
        revisions.estimated(picture * MS, added)
    revisions.revised(250 * MS, np.array([99.0, 3.0]))  # its estimate was lost
    pictures = np.array([10, 43, 60, 76, 110, 143], dtype=np.int64) * MS
    np.testing.assert_allclose(
        latencies(revisions, pictures), np.array([90, 107, 90, 74, 90]) * 1e-3
    )


def test_estimates_that_added_nothing_say_nothing():
    revisions = Revisions()
    revisions.revised(100 * MS, np.zeros(2))
    revisions.estimated(10 * MS, np.zeros(2))
    assert not len(latencies(revisions, np.array([10 * MS])))
    assert "latency_median_s" not in described(np.zeros((3, 2)), np.empty(0))


def test_ways_of_playing_stand_side_by_side():
    assert control_of("learned 2 + feedback") == "learned_feedback"
    methods = {
        "optimal": 0.004,
        "optimal + feedback": 0.002,
        "learned 1": 0.003,
        "learned 2": 0.001,
    }
    result = evaluate_run(series(reference(FRAMES)))
    results = [
        replace(result, method=method, mean_error_m=error) for method, error in methods.items()
    ]
    (row,) = side_by_side(results)
    assert row["learned_m"] == 0.001
    assert row["feedback_m"] == 0.002
    assert row["learned_feedback_m"] is None
    assert "0.100" in side_by_side_table(results).text()
    assert not side_by_side_table(results[:1]).rows
