"""Crossed hoses: commands reach the right chambers, and what is measured comes back in order."""

from __future__ import annotations

import pytest

from pressure_driver.hoses import HoseError, Hoses
from pressure_driver.protocols import Telemetry


@pytest.mark.parametrize("wiring", ["1,2,3,4", "2,1,3,4", "3,4,1,2", "4 3 1 2", "2,1,4,3"])
def test_a_command_fills_the_valves_that_feed_the_chambers(wiring):
    hoses = Hoses(wiring, 2)
    valves = [int(word) - 1 for word in wiring.replace(",", " ").split()]
    wanted = (300.0, -500.0)
    told = hoses.to_board(wanted)
    # What a board makes of differential pressures: one valve of each pair is filled.
    filled = [max(0.0, sign * told[pair]) for pair in range(2) for sign in (1, -1)]
    assert [filled[valve] for valve in valves] == [300.0, 0.0, 0.0, 500.0]
    measured = hoses.from_board(Telemetry(chamber_pressure=tuple(filled), supply_pressure=7.0))
    assert measured.chamber_pressure == (300.0, 0.0, 0.0, 500.0)
    assert measured.valve_opening is None
    assert measured.supply_pressure == 7.0


@pytest.mark.parametrize(
    ("wiring", "said"),
    [
        ("1,2,3", "valves 1 to 4 once"),
        ("1,1,2,3", "valves 1 to 4 once"),
        ("a,b,c,d", "valves 1 to 4 once"),
        ("1,3,2,4", r"no pair of the board: swap the hoses of valves 3 and 2 \(chambers 2 and 3"),
    ],
)
def test_wirings_that_no_board_can_play_are_refused_with_the_remedy(wiring, said):
    with pytest.raises(HoseError, match=said):
        Hoses(wiring, 2)
