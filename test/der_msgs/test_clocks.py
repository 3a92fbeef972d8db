"""Clocks that are off: how far, how sure, and what a node says about it."""

import math

import numpy as np
import pytest

from limb_interfaces.clocks import LARGEST, Offset, OffsetEstimate

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def exchange(estimate, true_time, error, way, back):
    """Ask at this time of the driver's clock [ns]; return the node's clock when the answer came.

    Args:
        error: of the node's clock [ns] at a time of the driver's.
        way, back: [ns] that question and answer take.
    """
    received, answered = true_time + way, true_time + way + 20_000
    returned = answered + back
    now = returned + error(returned)
    estimate.add(true_time + error(true_time), received, answered, now)
    return now


@pytest.mark.parametrize("seed", range(4))
def test_a_clock_that_is_off_and_runs_fast_is_told_within_its_uncertainty(seed):
    """30 ms behind and 50 ppm fast; one way in ten is held up by up to 40 ms."""
    generator = np.random.default_rng(seed)
    estimate = OffsetEstimate()

    def error(time):
        return -30_000_000 + round(50e-6 * (time - START))

    for second in range(200):
        ways = generator.exponential(300_000.0, 2) + 100_000.0
        ways += (generator.random(2) < 0.1) * generator.uniform(0.0, 40e6, 2)
        true_time = START + second * SECOND
        now = exchange(estimate, true_time, error, *map(round, ways))
        offset = estimate.at(now)
        truth = -1e-9 * error(true_time)
        assert abs(offset.seconds - truth) <= offset.uncertainty + 1e-6
    assert offset.uncertainty < 1.5e-3
    assert "behind the driver's" in offset.warning
    assert "chrony" in offset.warning
    assert offset.too_far


def test_a_clock_that_was_set_is_noticed_with_the_next_answer():
    estimate = OffsetEstimate()
    for second in range(10):
        exchange(estimate, START + second * SECOND, lambda _: 0, 200_000, 200_000)
    now = exchange(estimate, START + 10 * SECOND, lambda _: 5_000_000, 300_000, 300_000)
    offset = estimate.at(now)
    assert offset.seconds == pytest.approx(-5e-3, abs=1e-6)
    assert "5.0 ms ahead of the driver's" in offset.warning
    assert not offset.too_far


def test_what_is_not_sure_is_no_reason_to_warn():
    assert Offset(8e-3, 9e-3).warning == ""
    assert Offset(0.9e-3, 1e-4).warning == ""
    assert Offset(math.nan, math.inf).warning == ""
    assert not Offset(2.0 * LARGEST, 3.0 * LARGEST).too_far


def test_an_answer_from_before_its_question_tells_nothing():
    estimate = OffsetEstimate()
    estimate.add(START, START + 50, START + 60, START - SECOND)
    assert math.isnan(estimate.at(START).seconds)
