from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from apriltag_tracker.camera.calibration import BoardFinder
from apriltag_tracker.detection import Detector
from apriltag_tracker.family import FAMILIES
from apriltag_tracker.sheets import (
    BoardLayout,
    SheetError,
    board_page,
    drawing,
    tag_pages,
    write_pdf,
)
from apriltag_tracker.tag_map import LimbTag, TagMap


def rasterise(page, dots_per_mm: float) -> np.ndarray:
    """Return a page as a grey image."""
    figure = drawing(page)
    figure.set_dpi(25.4 * dots_per_mm)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., 0])


@pytest.mark.parametrize("name", ["tag36h11", "tagStandard41h12"])
def test_printed_tags_have_their_size_and_direction(tags, name):
    dots, tags = 4.0, dataclasses.replace(tags, family=FAMILIES[name])
    detector = Detector(family=FAMILIES[name])
    found = {
        tag.id: tag for page in tag_pages(tags) for tag in detector.detect(rasterise(page, dots))
    }
    assert found.keys() == set(tags.ids)
    for entry in (*tags.limb, *tags.world):
        corners = found[entry.id].corners
        assert found[entry.id].pixel_size / dots == pytest.approx(1e3 * entry.size, abs=0.3)
        right, up = corners[1] - corners[0], corners[3] - corners[0]
        assert right[0] > 0.9 * np.hypot(*right)
        assert up[1] < -0.9 * np.hypot(*up)


def test_the_board_is_seen_with_its_squares_at_the_right_distance():
    layout, dots = BoardLayout(), 4.0
    view = BoardFinder(layout).find(rasterise(board_page(layout), dots), "sheet")
    assert len(view.pixels) == (layout.columns - 1) * (layout.rows - 1)
    apart = view.pixels[:, None] - view.pixels[None]
    true = view.points[:, None, :2] - view.points[None, :, :2]
    assert np.abs(apart / dots / 1e3 - true).max() < 2e-4


def test_sheets_are_drawn_in_millimetres(tmp_path, tags):
    pages = tag_pages(tags)
    write_pdf(pages, tmp_path / "tags.pdf")
    data = (tmp_path / "tags.pdf").read_bytes()
    boxes = re.findall(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+) ?\]", data)
    assert len(boxes) == len(pages)
    size = [float(points) / 72.0 * 25.4 for points in boxes[0]]
    assert size == pytest.approx((210.0, 297.0), abs=1e-3)
    assert b"/Subtype /Image" not in data


def test_what_does_not_fit_is_refused():
    large = TagMap((0.1,), (LimbTag(0, 0.0, 0.0, 0.3),), ())
    with pytest.raises(SheetError, match="does not fit"):
        tag_pages(large)
    with pytest.raises(SheetError, match="does not fit"):
        board_page(BoardLayout(columns=20))
    with pytest.raises(SheetError, match="half millimetres"):
        board_page(BoardLayout(square=0.0251))
    with pytest.raises(SheetError, match="3 or more"):
        BoardLayout(rows=2)


def test_many_tags_take_several_pages():
    tags = TagMap((1.0,), tuple(LimbTag(k, 0.0, 0.0, 0.04) for k in range(40)), ())
    pages = tag_pages(tags, "letter")
    assert len(pages) > 1
    assert sum(len(page.cuts) for page in pages) == 40
    for page in pages:
        for x, y, w, h in page.cuts:
            assert 0.0 < x < x + w < page.width
            assert 0.0 < y < y + h < page.height - 16.0
