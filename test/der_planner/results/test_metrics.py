"""Errors of runs whose errors are known in closed form."""

import numpy as np
import pytest
from runs import FRAMES, TIMES, reference, series

from der_planner.bags.run import PressureArrays
from der_planner.results import (
    Description,
    EvaluationError,
    RunSeries,
    evaluate_run,
)
from der_planner.results.errors import split_error


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
