"""Figures are drawn from what was measured."""

import numpy as np
from matplotlib.figure import Figure
from runs import FRAMES, reference, series

from der_planner.results.figures import (
    COLUMN,
    colours_of,
    mean_error,
    paper_style,
    shared_legend,
)


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


def test_methods_of_a_model_are_told_apart_in_a_legend_that_is_whole():
    runs = [series(reference(FRAMES), method=f"optimal, learned {n}") for n in range(5)]
    colours = colours_of(runs)
    assert len(set(colours.values())) == 5
    with paper_style():
        figure = Figure(figsize=(COLUMN, 2.2))
        axis = figure.subplots()
        for label, colour in colours.items():
            axis.plot([0.0, 1.0], color=colour, label=label)
        shared_legend(figure, [axis])
        figure.canvas.draw()
        drawn = figure.legends[0].get_window_extent()
        assert drawn.x0 >= 0.0
        assert drawn.x1 <= figure.bbox.x1
