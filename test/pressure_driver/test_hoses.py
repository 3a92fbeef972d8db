"""Crossed hoses: commands reach the right chambers, and what is measured comes back in order."""

import pytest

from pressure_driver.protocols import SettingError
from pressure_driver.settings import Settings


@pytest.mark.parametrize(
    ("protocol", "wiring"),
    [("ezloop", "3,4,2,1"), ("native", "1,3,2,4"), ("festo", "4 1 3 2"), ("pneudrive", "2,3,4,1")],
)
def test_a_command_fills_the_valves_that_feed_the_chambers(simulate, protocol, wiring):
    sim = simulate(protocol, wiring=wiring)
    sim.track()
    valves = [int(word) - 1 for word in wiring.replace(",", " ").split()]
    filled = [sim.gauge[valve] > 2_000.0 for valve in valves]
    assert filled == [True, False, False, True]
    assert [value > 2_000.0 for value in sim.core.monitor.gauge] == filled


@pytest.mark.parametrize(
    ("protocol", "wiring", "said"),
    [
        ("native", "1,2,3", "name each of 1, 2, 3, 4 once"),
        ("native", "1,1,2,3", "name each of 1, 2, 3, 4 once"),
        ("ezloop", "1,3,2,4", "hoses of each segment on one pair"),
    ],
)
def test_wirings_that_no_board_can_play_are_refused_with_the_remedy(protocol, wiring, said):
    with pytest.raises(SettingError, match=said):
        Settings(protocol=protocol, wiring=wiring)
