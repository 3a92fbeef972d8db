"""Families of tags, and how they are printed."""

from __future__ import annotations

import ctypes
import dataclasses
import re
from pathlib import Path

import numpy as np
import pyapriltags.apriltags as c_library
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from apriltag_tracker import family
from apriltag_tracker.camera.calibration import BoardFinder
from apriltag_tracker.detection import Detector
from apriltag_tracker.family import FAMILIES, TAG36H11
from apriltag_tracker.pipeline import LimbTracker
from apriltag_tracker.sheets import (
    BoardLayout,
    SheetError,
    board_page,
    drawing,
    tag_pages,
    write_pdf,
)
from apriltag_tracker.synthetic.camera import Optics, SyntheticCamera
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


EACH = pytest.mark.parametrize("each", FAMILIES.values(), ids=FAMILIES)
STANDARD = ("tagStandard41h12", "tagStandard52h13")


@EACH
def test_codes_differ_in_as_many_cells_as_stated_however_they_are_turned(each):
    mask, codes = each.code_mask(), each.codes()
    cells = np.zeros((each.tag_count, *mask.shape), dtype=np.uint8)
    cells[:, mask] = codes
    some = np.arange(0, each.tag_count, max(each.tag_count // 16, 1))
    nearest = []
    for turn in range(4):
        turned = np.rot90(cells, turn, axes=(1, 2))[:, mask]
        distance = np.array([(code != turned).sum(axis=1) for code in codes[some]])
        if turn == 0:
            distance[np.arange(len(some)), some] = 99
        nearest.append(distance.min())
    assert min(nearest) >= int(each.name.rpartition("h")[2])


def test_codes_that_no_other_library_here_has_are_the_published_ones():
    bits = FAMILIES["tag36h10"].codes()[0]
    assert int("".join(map(str, bits)), 2) == 0x1CA92A687


@pytest.mark.parametrize("name", STANDARD)
def test_standard_tags_are_printed_as_the_c_library_draws_them(name):
    """Every cell of `apriltag_to_image`, which also makes the published pictures of the tags."""
    library = ctypes.CDLL(str(Path(c_library.__file__).parent / "libapriltag.so"))
    create = getattr(library, f"{name}_create")
    create.restype = ctypes.POINTER(c_library._ApriltagFamily)
    library.apriltag_to_image.restype = ctypes.POINTER(c_library._ImageU8)
    theirs, ours = create(), FAMILIES[name]
    assert theirs.contents.ncodes == ours.tag_count
    assert theirs.contents.width_at_border == ours.border_cells
    assert theirs.contents.h == int(name.rpartition("h")[2])
    for tag in range(0, ours.tag_count, max(ours.tag_count // 700, 1)):
        drawn = library.apriltag_to_image(theirs, tag).contents
        cells = np.ctypeslib.as_array(drawn.buf, (drawn.height, drawn.stride))[:, : drawn.width]
        assert np.array_equal(cells > 0, ours.printed_cells(tag) > 0)


def test_other_tags_and_families_are_refused_with_those_that_there_are():
    for tag in (-1, 587):
        with pytest.raises(ValueError, match="0 to 586"):
            TAG36H11.printed_cells(tag)
    for name in ("tagCircle49h12", 36, None):
        with pytest.raises(ValueError, match=r"there are tag36h11, .* tag16h5, tagStandard41h12"):
            family.named(name)


@pytest.mark.parametrize("name", ["tag16h5", "tagStandard41h12"])
def test_a_limb_with_another_family_is_tracked(tags, model, swing, name):
    limb = tuple(dataclasses.replace(tag, id=k) for k, tag in enumerate(tags.limb))
    world = tuple(dataclasses.replace(tag, id=20 + k) for k, tag in enumerate(tags.world))
    other = dataclasses.replace(tags, limb=limb, world=world, stiff=(), family=FAMILIES[name])
    camera = SyntheticCamera(model, other, Optics(), seed=5)
    tracker = LimbTracker(other, model.intrinsics)
    for k in range(3):
        moment = 0.4 + k / 30.0
        frame = camera.frame(swing.shape(moment))
        observation = tracker.observe(frame.image, k / 30.0)
    gap = observation.estimate.tip - swing.shape(moment).points[-1]
    assert np.hypot(*gap) < 1e-4
    # The size of a standard tag is the edge of its white border: places would not fit otherwise.
    fixed = {tag.id: tag for tag in other.world}
    for placed in observation.tags:
        if placed.tag.id in fixed:
            assert np.hypot(*(placed.pose[:2] - fixed[placed.tag.id].position[:2])) < 1e-4
    assert len(observation.tags) == len(other.ids)
