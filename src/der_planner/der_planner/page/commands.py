"""What the page can ask of the graph; `node` does it by ROS services and topics."""

from __future__ import annotations

import asyncio
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Service = Literal["vent", "arm", "start", "stop", "record_start", "record_stop"]

PATIENCE = 3.0
"""[s] to wait for a service's answer."""

FILLING = 3.0
"""[s] for which a chamber is filled alone; then the driver holds and lets it down by itself."""

OWNERS: dict[Service, str] = {
    "vent": "pressure_driver",
    "arm": "pressure_driver",
    "start": "planner",
    "stop": "planner",
    "record_start": "recorder",
    "record_stop": "recorder",
}
"""The node that serves each."""


@dataclass(frozen=True)
class Answer:
    """What came of a request, in the words of the node that was asked."""

    success: bool
    message: str


@dataclass(frozen=True)
class Load:
    """How the limb is mounted and what it carries, as a motion command says it.

    Attributes:
        payload: [kg] carried beside the limb's own masses; 0: the planner's parameter.
        payload_at: [m] where, along the limb from its clamp; 0: the tip.
        mounting: a name or degrees of tilt; empty: the planner's parameter.
    """

    payload: float = 0.0
    payload_at: float = 0.0
    mounting: str = ""


@dataclass(frozen=True)
class Conditions:
    """What a motion or a drawing is planned with.

    Attributes:
        model: `der` or `pcc`.
        method: of the planner; empty: the best for the model.
        load: mounting and payload.
        feedback: correct the setpoints while the limb moves.
    """

    model: str = "der"
    method: str = ""
    load: Load = Load()
    feedback: bool = False


@dataclass(frozen=True)
class MotionRequest:
    """A named motion to play, or a learned plan, whose name is the motion's and method `learned`.

    Attributes:
        motion: its name.
        amplitude: [rad].
        period: [s] of one cycle.
        cycles: how many.
        conditions: what it is planned with.
    """

    motion: str
    amplitude: float
    period: float
    cycles: int
    conditions: Conditions


class Commands(Protocol):
    """The graph as the page commands it; every method returns at once, from any thread."""

    def call(self, service: Service) -> Future[Answer]:
        """Call a service; the future fails only if the page itself is at fault."""
        ...

    def play(self, request: MotionRequest) -> Answer:
        """Ask the planner to plan and play a motion."""
        ...

    def fill(self, segment: int, side: int, pressure: float) -> Answer:
        """Fill one chamber alone for `FILLING`.

        Args:
            segment: its number, 0 at the clamp.
            side: 1 for the left chamber, which bends counter-clockwise, -1 for the right one.
            pressure: differential pressure [Pa], above zero.
        """
        ...

    def play_path(self, tip: NDArray[np.float64], conditions: Conditions) -> Answer:
        """Ask the planner to play the nearest path to points (P, 2) [m] that it can."""
        ...

    def learned_plans(self) -> list[str]:
        """Return the names of the learned plans that the planner can play."""
        ...

    def record(self, note: str) -> Future[Answer]:
        """Start recording, with a note in the bag."""
        ...


async def answer_of(service: Service, pending: Future[Answer]) -> Answer:
    """Wait for a service's answer, and say so if none comes."""
    owner = OWNERS[service]
    try:
        return await asyncio.wait_for(asyncio.wrap_future(pending), PATIENCE)
    except asyncio.TimeoutError:
        text = f"no answer from {owner} within {PATIENCE:.0f} s"
    except Exception as error:  # whatever failed, the operator must read it
        text = f"{owner}: {error or type(error).__name__}"
    if service == "vent":
        text += (
            ": NOT VENTED as far as the page knows; close the supply and open the valves by hand"
        )
    return Answer(False, text)
