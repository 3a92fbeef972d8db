"""What people write into the fields of a motion command."""

from __future__ import annotations

import pytest

from der_planner.page.forms import FormError, read_mounting, read_number


@pytest.mark.parametrize(("text", "value"), [("12,5", 12.5), (" 2.5 ", 2.5), ("0", 0.0), (3, 3.0)])
def test_numbers_are_read_as_people_write_them(text: object, value: float) -> None:
    assert read_number(text, 0.0, 100.0) == value


@pytest.mark.parametrize("text", ["", None, "1,000.5", "1_0", "nan", "inf", "-1", "101", "ten"])
def test_what_is_no_number_is_refused_with_the_range(text: object) -> None:
    with pytest.raises(FormError, match="from 0 to 100"):
        read_number(text, 0.0, 100.0)
    # A thousand in one country, and one in another.
    with pytest.raises(FormError, match="no mark of thousands"):
        read_number("1,000", 0.0, 10_000.0)


def test_mountings_are_names_or_degrees() -> None:
    assert read_mounting(None) == ""
    assert read_mounting("hanging") == "hanging"
    assert float(read_mounting("12,5°")) == 12.5
    with pytest.raises(FormError, match="upside down"):
        read_mounting("upside down")
