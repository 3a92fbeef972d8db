"""Figures are drawn from what was measured."""

import numpy as np
from runs import FRAMES, reference, series

from der_planner.results.figures import mean_error


def test_mean_error_over_trials_ignores_gaps():
    one = series(reference(FRAMES) + np.array([0.0, 0.002]))
    tip = reference(FRAMES) + np.array([0.0, 0.006])
    tip[(FRAMES > 3.0) & (FRAMES < 4.0)] = np.nan
    two = series(tip, trial=1)
    time, mean, deviation = mean_error([one, two])
    both = (time < 2.8) | (time > 4.2)
    alone = (time > 3.2) & (time < 3.8)
    assert np.allclose(mean[both], 0.004, atol=5e-5)
    assert np.allclose(deviation[both], np.std([0.002, 0.006], ddof=1), atol=5e-5)
    assert np.allclose(mean[alone], 0.002, atol=5e-5)
    assert np.all(deviation[alone] == 0)
