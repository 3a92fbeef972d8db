"""Errors that are known in closed form, means over trials, and what must not be compared."""

import dataclasses
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from runs import FRAMES, TIMES, reference, series

from der_planner.bags.record import Revisions
from der_planner.bags.run import BoardLog, PressureArrays, Stream
from der_planner.bags.series import described, latencies
from der_planner.results import (
    Description,
    EvaluationError,
    RunSeries,
    compare,
    evaluate_run,
    format_table,
    summarise,
    write_results,
)
from der_planner.results.errors import check_board, split_error
from der_planner.results.report import side_by_side_table
from der_planner.results.statistics import control_of, side_by_side
from der_planner.results.tables import csv_table, error_table


def result(error: float, model="der", trial=0, **changes):
    found = evaluate_run(
        series(reference(FRAMES) + np.array([0.0, error]), model=model, trial=trial, seed=trial)
    )
    return dataclasses.replace(found, **{"mean_error_m": error, **changes})


DER = [result(e, trial=t) for t, e in enumerate([0.010, 0.012, 0.014])]
PCC = [result(e, "pcc", t) for t, e in enumerate([0.020, 0.021, 0.025])]


def test_paired_difference_and_interval():
    (found,) = compare([*DER, *PCC])
    assert found.paired
    assert found.difference_m == pytest.approx(0.010)
    # Every resampled mean lies between the least and the largest difference.
    assert 0.0089 < found.low_m <= found.difference_m <= found.high_m < 0.0111
    assert compare([*DER, *PCC])[0] == found


def test_interval_covers_the_truth_as_often_as_it_says():
    random = np.random.default_rng(1)
    covered = 0
    for _ in range(60):
        one, two = (
            [
                dataclasses.replace(run, seed=i, mean_error_m=mean + random.normal(0, 1e-3))
                for i in range(12)
            ]
            for run, mean in ((DER[0], 0.01), (PCC[0], 0.02))
        )
        (found,) = compare([*one, *two])
        covered += found.low_m <= 0.01 <= found.high_m
    assert 50 <= covered <= 60


def test_unpaired_trials_and_single_trials():
    shifted = [dataclasses.replace(run, seed=run.seed + 10) for run in PCC]
    (found,) = compare([*DER, *shifted])
    assert not found.paired
    assert found.low_m < found.difference_m < found.high_m
    (single,) = compare([DER[0], PCC[0]])
    assert single.difference_m == pytest.approx(0.010)
    assert math.isnan(single.low_m)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"problems": ("the driver reported a fault: x",)}, "fault"),
        ({"window_s": (1.0, 8.0)}, "different windows"),
        (
            {"reference_points_m": tuple((x, y + 0.006) for x, y in DER[0].reference_points_m)},
            "up to 6.0 mm apart",
        ),
    ],
)
def test_what_is_not_comparable_is_refused_with_the_reason(change, reason):
    (found,) = compare([*DER, *PCC[:2], dataclasses.replace(PCC[2], **change)])
    assert reason in found.refused
    assert math.isnan(found.difference_m)
    assert "not compared" in format_table(summarise([*DER, *PCC]), [found])


def test_a_comparison_under_different_methods_says_so():
    runs = [dataclasses.replace(run, method="optimal") for run in [*DER, *PCC]]
    (same,) = compare(runs)
    assert "methods differ" not in format_table([], [same])
    (mixed,) = compare([*runs[:3], *(dataclasses.replace(r, method="paper") for r in PCC)])
    assert "der optimal against pcc paper (methods differ" in format_table(
        [*summarise(runs)], [mixed]
    )


def test_other_motions_and_loads_are_not_mixed():
    other = [dataclasses.replace(run, motion="asynchronous") for run in PCC]
    assert compare([*DER, *other]) == []
    hung = [dataclasses.replace(run, mounting="hanging", payload_kg=0.02) for run in [*DER, *PCC]]
    level, loaded = compare([*DER, *PCC, *hung])
    assert (level.loads, loaded.loads) == ("", "hanging, 20 g")
    rows = summarise([*DER, *PCC, *hung])
    assert len(rows) == 4
    text = format_table(rows, [level, loaded])
    assert "same_direction (hanging, 20 g): der" in text
    assert "loads" not in format_table(summarise(DER))


def test_results_file(tmp_path):
    path = write_results([*DER, *PCC], tmp_path)
    document = json.loads(path.read_text())
    assert len(document["runs"]) == 6
    assert [entry["trials"] for entry in document["summary"]] == [3, 3]
    assert document["comparisons"][0]["difference_m"] == pytest.approx(0.01)
    assert document["runs"][0]["mean_error_m"] == DER[0].mean_error_m
    assert document["runs"][0]["longest_gap_s"] > 0
    assert list(tmp_path.iterdir()) == [path]


def test_tables_hold_the_same_numbers():
    rows = summarise([*DER, *PCC])
    assert "1.20 ± 0.20" in format_table(rows)
    markdown, latex = error_table(rows).markdown(), error_table(rows).latex()
    assert "1.20 ± 0.20" in markdown
    assert r"1.20 \pm 0.20" in latex
    assert latex.count(r"\\") == 3
    head, first, _ = csv_table(rows).splitlines()
    values = dict(zip(head.split(","), first.split(","), strict=True))
    assert float(values["mean_error_m"]) == pytest.approx(0.012)
    assert {line.count("|") for line in markdown.splitlines()} == {10}


def board(**changes) -> BoardLog:
    time = 0.05 * np.arange(50)
    value = np.column_stack([4000 * np.sin(time), -4000 * np.cos(time)])
    arrays = {
        "setpoint_time": time,
        "setpoint": value,
        "command_time": time + 0.003,
        "command": np.round(value, -2),
    }
    return BoardLog(**{**arrays, **changes})


def test_lost_late_and_swapped_commands_are_told_apart():
    whole = board()
    assert check_board(whole)["board_received"] == 50
    keep = np.arange(50) != 20
    lost = check_board(board(command_time=whole.command_time[keep], command=whole.command[keep]))
    assert (lost["board_received"], lost["board_lost"]) == (49, 1)
    assert lost["board_lateness_max_s"] == pytest.approx(0.003)

    time = whole.command_time.copy()
    time[20] += 0.12
    order = np.argsort(time, kind="stable")
    late = check_board(board(command_time=time[order], command=whole.command[order]))
    assert late["board_lost"] == 0
    assert late["board_out_of_order"] == 1
    assert late["board_lateness_max_s"] == pytest.approx(0.123)

    values = whole.command.copy()
    values[20] += 3000.0
    wrong = check_board(board(command=values))
    assert wrong["board_lost"] == 1


def test_commands_of_one_value_are_in_order_however_late():
    whole = board()
    time = whole.command_time.copy()
    time[20] += 0.04
    time[21] += 0.008
    still = board(command_time=time, setpoint=np.zeros((50, 2)), command=np.zeros((50, 2)))
    checks = check_board(still)
    assert (checks["board_lost"], checks["board_out_of_order"]) == (0, 0)


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
    # Runs under other loads are not of the same row.
    hanging = [replace(run, mounting="hanging", mean_error_m=0.009) for run in results[:2]]
    bare, loaded = side_by_side([*results[:2], *hanging])
    assert (bare["open_loop_m"], loaded["open_loop_m"]) == (0.004, 0.009)
    assert loaded["loads"] == "hanging"
    assert side_by_side([results[0], hanging[1]]) == []


def test_constant_offset_is_the_error_and_the_bias():
    result = evaluate_run(series(reference(FRAMES) + np.array([0.003, -0.004])))
    # The reference is interpolated linearly between setpoints: 0.02 mm at this speed.
    assert result.mean_error_m == pytest.approx(0.005, abs=5e-5)
    assert result.mean_error_x_m == pytest.approx(0.003, abs=5e-5)
    assert result.mean_error_y_m == pytest.approx(0.004, abs=5e-5)
    assert result.rms_error_m == pytest.approx(0.005, abs=5e-5)
    assert (result.bias_x_m, result.bias_y_m) == pytest.approx((0.003, -0.004), abs=5e-5)
    assert result.lag_s == pytest.approx(0.0, abs=1e-3)
    assert result.rms_without_bias_m < 1e-4
    assert result.predicted_error_m == pytest.approx(0.001)
    assert result.valid_fraction == 1.0
    assert result.problems == ()


@pytest.mark.parametrize(("played", "problems"), [(1.0, 0), (0.95, 0), (0.0, 1), (-1.0, 1)])
def test_a_run_of_which_the_driver_commanded_something_else_says_so(played, problems):
    plan = 8_000.0 * np.sin(TIMES)[:, None] * [1.0, -0.5]
    run = series(reference(FRAMES))
    run = replace(run, setpoints=Stream(TIMES, plan), commanded=Stream(TIMES, played * plan))
    found = evaluate_run(run).problems
    assert len(found) == problems
    assert all("the driver commanded other pressures" in text for text in found)


def test_components_are_means_of_absolute_values():
    wave = np.where(np.arange(len(FRAMES)) % 2, 0.002, -0.002)
    result = evaluate_run(series(reference(FRAMES) + np.column_stack([wave, 0 * wave])))
    assert result.mean_error_x_m == pytest.approx(0.002, abs=3e-5)
    assert result.mean_error_y_m < 5e-5
    assert abs(result.bias_x_m) < 3e-5


def test_only_frames_between_first_and_last_setpoint_count():
    tip = reference(FRAMES) + np.array([0.0, 0.001])
    outside = (FRAMES < 0) | (TIMES[-1] < FRAMES)
    tip[outside] += 1.0
    result = evaluate_run(series(tip))
    assert result.max_error_m < 0.0011
    assert result.frames == int((~outside).sum())


@pytest.mark.parametrize("lag", [-0.2, 0.013, 0.35])
def test_lag_gain_and_bias_are_told_apart(lag: float):
    late = reference(FRAMES - lag)
    mean = np.array([0.2, 0.0])
    tip = mean + (late - mean) * [0.9, 1.2] + [0.002, -0.005]
    tip += np.random.default_rng(5).normal(0.0, 2e-4, tip.shape)
    found = split_error(series(tip))
    assert found.lag_s == pytest.approx(lag, abs=2e-3)
    assert (found.gain_x, found.gain_y) == pytest.approx((0.9, 1.2), abs=5e-3)
    assert (found.bias_x_m, found.bias_y_m) == pytest.approx((0.002, -0.005), abs=2e-3)
    assert found.rms_without_lag_m >= found.rms_without_bias_m >= found.rms_without_gain_m
    assert found.rms_without_gain_m == pytest.approx(2e-4 * np.sqrt(2), rel=0.2)


def test_nothing_is_shifted():
    late = evaluate_run(series(reference(FRAMES - 0.3)))
    assert late.mean_error_m > 0.01
    assert late.lag_s == pytest.approx(0.3, abs=1e-3)
    assert late.rms_without_lag_m < 1e-3


def test_reference_that_rests_has_no_lag():
    rest = RunSeries.from_arrays(
        Description("rest", "der"),
        time=FRAMES,
        tip=np.tile([0.24, 0.001], (len(FRAMES), 1)),
        reference_time=TIMES,
        tip_reference=np.tile([0.24, 0.0], (len(TIMES), 1)),
    )
    assert split_error(rest).lag_s == 0.0
    assert evaluate_run(rest).mean_error_m == pytest.approx(0.001)


def test_invalid_images_and_gaps_are_counted_and_named():
    tip = reference(FRAMES) + np.array([0.0, 0.001])
    lost = (FRAMES > 2.0) & (FRAMES < 3.5)
    tip[lost] = np.nan
    result = evaluate_run(series(tip))
    inside = (FRAMES >= 0) & (TIMES[-1] >= FRAMES)
    assert result.valid_fraction == pytest.approx(1 - lost.sum() / inside.sum())
    assert result.longest_gap_s == pytest.approx(1.5, abs=0.05)
    assert result.mean_error_m == pytest.approx(0.001, abs=5e-5)
    assert any("1.5 s without" in text for text in result.problems)
    assert any("83%" in text for text in result.problems)
    with pytest.raises(EvaluationError, match="no valid limb state"):
        evaluate_run(series(np.full((len(FRAMES), 2), np.nan)))


def test_missing_images_are_estimated_from_stamps():
    keep = np.ones(len(FRAMES), dtype=bool)
    keep[[60, 100, 101, 102, 150]] = False
    result = evaluate_run(series(reference(FRAMES[keep]), time=FRAMES[keep]))
    assert result.dropped_frames == 5
    assert result.valid_fraction == 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"time": FRAMES[::-1]}, "times of tip must be two or more rising"),
        ({"tip": reference(FRAMES)[:-1]}, r"tip must have shape \(\d+, 2\)"),
        ({"pressures": PressureArrays(TIMES, np.zeros(3))}, "commanded must have shape"),
    ],
)
def test_arrays_of_wrong_shape_are_named(changes, message):
    arrays = {
        "time": FRAMES,
        "tip": reference(FRAMES),
        "reference_time": TIMES,
        "tip_reference": reference(TIMES),
    }
    with pytest.raises(EvaluationError, match=message):
        RunSeries.from_arrays(Description("m", "der"), **{**arrays, **changes})
