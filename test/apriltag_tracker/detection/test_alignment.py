"""The whole pattern against pictures by brute force, which share no formula with the fit."""

from __future__ import annotations

import numpy as np
import pytest

from apriltag_tracker.detection.alignment.aligner import Aligner
from apriltag_tracker.detection.alignment.pattern import tabulate
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


def test_the_table_is_the_pattern_and_its_derivatives():
    cells = TAG36H11.printed_cells(3, 1)
    table = tabulate(cells, 10, 0.2).astype(float)
    assert table[55, 55, 0] == pytest.approx(cells[5, 5], abs=0.03)
    step = 0.1
    assert np.allclose(
        table[1:-1, 2:, 0] - table[1:-1, :-2, 0], 2 * step * table[1:-1, 1:-1, 1], atol=0.05
    )
    wider = tabulate(cells, 10, 0.202)[:, :, 0] - tabulate(cells, 10, 0.198)[:, :, 0]
    assert np.allclose(wider, 0.004 * table[:, :, 3], atol=1e-4)


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
