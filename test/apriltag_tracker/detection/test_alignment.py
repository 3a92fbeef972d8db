"""The whole pattern against pictures by brute force, which share no formula with the fit."""

from __future__ import annotations

import numpy as np
import pytest

from apriltag_tracker.detection.alignment.aligner import Aligner
from apriltag_tracker.detection.alignment.pattern import EDGE_VALUES, framed, look_at
from apriltag_tracker.family import TAG36H11
from apriltag_tracker.synthetic.camera import Optics, SyntheticCamera
from benchmarks.tracker.renderer import Scene, render


def errors_and_nees(scene, seeds=(0, 1)):
    """Fit every tag from corners that are 0.4 px off; returns errors (n, 8), NEES / 8, and fits."""
    aligner, random = Aligner(), np.random.default_rng(5)
    errors, nees, fits = [], [], []
    for seed in seeds:
        image, truth = render(scene, seed, (320, 240))
        for tag, corners in truth.items():
            start = corners + random.normal(0.0, 0.3, 2) + random.normal(0.0, 0.25, (4, 2))
            fitted = aligner.align(image, tag, start)
            assert fitted is not None
            gap = (fitted.corners - corners).ravel()
            errors.append(gap)
            nees.append(gap @ np.linalg.solve(fitted.covariance, gap) / 8.0)
            fits.append(fitted)
    return np.array(errors), np.array(nees), fits


@pytest.mark.parametrize(
    ("scene", "limit"),
    [
        (Scene("sharp"), 0.02),
        (Scene("blur", blur=1.5), 0.05),
        (Scene("defocus", defocus=2.0), 0.04),
        (Scene("noise", noise=12.0), 0.08),
        (Scene("dark", contrast=0.12), 0.12),
        (Scene("smear of 3 px", smear=3.0), 0.03),
        (Scene("smear of 6 px", smear=6.0), 0.05),
    ],
    ids=lambda value: value.name if isinstance(value, Scene) else None,
)
def test_corners_and_their_covariance_are_honest(scene, limit):
    errors, nees, fits = errors_and_nees(scene)
    assert len(errors) >= 20
    assert np.sqrt(np.mean(errors**2)) < limit
    assert 0.5 < nees.mean() < 2.0
    smears = np.array([np.hypot(*fitted.smear) for fitted in fits])
    if scene.smear:
        assert np.abs(smears - scene.smear).max() < 0.3


def blurred_by_sampling(cells, blur, column, row):
    """Sum the cells' shares of a Gaussian, sampled finely; the outer cells go on for ever."""
    reach = np.linspace(-6.0 * blur, 6.0 * blur, 601)
    weights = np.exp(-0.5 * (reach / blur) ** 2)
    shares = []
    for place in (row, column):
        index = np.clip(np.floor(place + reach), 0, len(cells) - 1).astype(int)
        shares.append(np.bincount(index, weights, len(cells)) / weights.sum())
    return shares[0] @ cells @ shares[1]


@pytest.mark.parametrize("blur", [0.1, 0.2, 0.7, 1.8])
def test_the_pattern_is_blurred_cells_and_has_its_derivatives(blur):
    cells = framed(TAG36H11.printed_cells(3, 1))
    random = np.random.default_rng(4)
    room = np.empty((2, len(cells), EDGE_VALUES))

    def look(blur, column, row):
        return np.array(look_at(cells, blur, column, row, *room))

    for column, row in random.uniform(1.0, 11.0, (60, 2)):
        value, by_column, by_row, by_blur = look(blur, column, row)
        assert value == pytest.approx(blurred_by_sampling(cells, blur, column, row), abs=6e-3)
        h = 0.02 * blur
        for slope, ahead, behind in (
            (by_column, look(blur, column + h, row), look(blur, column - h, row)),
            (by_row, look(blur, column, row + h), look(blur, column, row - h)),
            (by_blur, look(blur + h, column, row), look(blur - h, column, row)),
        ):
            assert slope == pytest.approx((ahead[0] - behind[0]) / (2 * h), abs=0.01 / blur)


def test_a_pattern_of_another_tag_explains_little():
    image, truth = render(Scene("sharp"), 0, (320, 240))
    aligner = Aligner()
    for tag, corners in truth.items():
        other = aligner.align(image, (tag + 1) % TAG36H11.tag_count, corners)
        assert other is None or other.explained < 0.9


def test_sides_that_the_lens_bends_do_not_shift_the_corners(tags, model):
    """Where a lens bends a side by 0.07 px, a homography alone is wrong by more than the noise."""
    lens = (model.intrinsics.matrix, model.intrinsics.distortion)
    camera = SyntheticCamera(model, tags, Optics(), seed=11)
    nees = {False: [], True: []}
    for _ in range(6):
        frame = camera.frame(None)
        for through, values in nees.items():
            aligner = Aligner(lens=lens if through else None)
            for tag, corners in frame.corners.items():
                fitted = aligner.align(frame.image, tag, corners + 0.1)
                gap = (fitted.corners - corners).ravel()
                values.append(gap @ np.linalg.solve(fitted.covariance, gap) / 8.0)
    assert np.mean(nees[False]) > 2.0
    assert 0.5 < np.mean(nees[True]) < 1.5
