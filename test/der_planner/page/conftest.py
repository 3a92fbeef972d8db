"""What the page knows of a graph, with a clock that the test sets."""

import pytest
from waiting import Clock

from der_planner.page.situation import Situation


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def situation(clock: Clock) -> Situation:
    return Situation(clock)
