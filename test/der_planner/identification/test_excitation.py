"""Tables of pressures that are to be played: what is refused, with the remedy."""

import pytest

from der_planner.identification import read_excitation


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("time_s,a,b\n0,0,0\n0.1,0,0\n", "must be 0, 0.05, 0.1"),
        ("time_s,a\n0,0\n0.05,0\n", "expected time_s and 2 pressures"),
    ],
)
def test_a_table_of_another_grid_or_limb_is_refused(tmp_path, rows, said):
    path = tmp_path / "excitation.csv"
    path.write_text(rows)
    with pytest.raises(ValueError, match=said):
        read_excitation(path, 2)
