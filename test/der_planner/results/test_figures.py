"""Figures are drawn from what was measured, and the same data gives the same file."""

import numpy as np
import pytest
from runs import FRAMES, reference, series

from der_planner.results import plot_tip
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


@pytest.mark.slow
def test_figures_are_written_and_repeatable(tmp_path):
    runs = [
        series(reference(FRAMES) + np.array([0.0, error]), model=model)
        for model, error in (("der", 0.002), ("pcc", 0.01))
    ]
    first, second = (plot_tip(runs, tmp_path / name) for name in ("one", "two"))
    assert [path.name for path in first] == ["tip.png", "tip.pdf"]
    for one, two in zip(first, second, strict=True):
        assert one.read_bytes() == two.read_bytes()
        assert one.stat().st_size > 5_000
