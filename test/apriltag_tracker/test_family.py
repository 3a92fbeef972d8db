from __future__ import annotations

import numpy as np
import pytest

from apriltag_tracker import family


def test_tag_0_reads_the_published_code():
    family.check_code_of_tag_0()


def test_a_turned_dictionary_is_noticed(monkeypatch):
    turned = np.rot90(family.codes(), 1, axes=(1, 2))
    monkeypatch.setattr(family, "codes", lambda: turned)
    with pytest.raises(family.FamilyError, match="turned in another way"):
        family.check_code_of_tag_0()


def test_codes_of_the_family_differ_in_eleven_bits_however_they_are_turned():
    codes = family.codes().reshape(family.TAG_COUNT, -1)
    chosen = codes[::40]
    for turn in range(4):
        turned = np.rot90(family.codes(), turn, axes=(1, 2)).reshape(family.TAG_COUNT, -1)
        distance = (chosen[:, None, :] != turned[None, :, :]).sum(axis=2)
        if turn == 0:
            distance[np.arange(len(chosen)), np.arange(0, family.TAG_COUNT, 40)] = 99
        assert distance.min() >= 11


def test_printed_cells_have_border_and_margin():
    cells = family.printed_cells(7, margin=2)
    assert cells.shape == (12, 12)
    assert cells[:2].min() == 1
    assert cells[:, -2:].min() == 1
    assert cells[2, 2:-2].max() == 0
    assert cells[2:-2, 2].max() == 0
    assert np.array_equal(cells[3:-3, 3:-3], family.codes()[7])


@pytest.mark.parametrize("tag", [-1, 587])
def test_unknown_tags_are_refused(tag):
    with pytest.raises(ValueError, match="0 to 586"):
        family.printed_cells(tag)
