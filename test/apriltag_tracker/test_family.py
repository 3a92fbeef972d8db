from __future__ import annotations

import ctypes
import dataclasses
from pathlib import Path

import numpy as np
import pyapriltags.apriltags as c_library
import pytest

from apriltag_tracker import family
from apriltag_tracker.family import FAMILIES, TAG36H11
from apriltag_tracker.pipeline import LimbTracker
from apriltag_tracker.synthetic.camera import Optics, SyntheticCamera

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


@EACH
def test_printed_cells_have_a_border(each):
    border = each.printed_cells(7)[each.rim : -each.rim, each.rim : -each.rim]
    assert set(border[0]) == set(border[:, -1]) == {int(each.outer_ring)}


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
