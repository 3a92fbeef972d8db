"""Whose setpoints are taken: those of one publisher, and of plans of this arming only.

A publisher is told by the numbers that it counts its messages with: the middleware of ROS 2 Jazzy
hands these to a node, and not the publisher's identity.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

RELEASE_TIME = 1.0
"""[s] of silence after which hand-typed setpoints, which have no plan, are taken again."""
REMEMBERED_PLANS = 1024
"""Plans that were heard before the last arming and are refused since."""
REMEMBERED_PUBLISHERS = 16
"""Publishers that were refused lately."""


class Origin(NamedTuple):
    """Where a setpoint came from."""

    topic: str
    number: int
    """The publisher's own count of its messages."""
    alone: bool
    """The topic has no other publisher."""


class PublisherGate:
    """Keeps to the publisher that is heard first after an arming, until the next arming."""

    def __init__(self) -> None:
        self.refused = 0
        """Setpoints of other publishers since the start."""
        self.release()

    def release(self) -> None:
        """Take whoever is heard next: the driver has been armed."""
        self._owner: Origin | None = None
        self._in_step = False
        self._others: OrderedDict[tuple[str, int], None] = OrderedDict()

    def refuse(self, origin: Origin) -> str:
        """Return why a setpoint from there is not taken, or nothing if it is."""
        reason = self._judge(origin)
        if reason:
            self.refused += 1
        else:
            self._owner = origin
        return reason

    def _judge(self, origin: Origin) -> str:
        owner = self._owner
        if owner is None:
            return ""
        counted = origin.number - owner.number if origin.topic == owner.topic else -1
        before = (origin.topic, origin.number - 1)
        # A number that two publishers have reached does not tell any more which of them goes on.
        if counted == 0 or (counted == 1 and before in self._others):
            self._in_step = True
        if self._in_step:
            return "two publishers count in step and cannot be told apart: stop one and arm again"
        if counted == 1 or (counted > 1 and origin.alone):
            return ""
        self._others.pop(before, None)
        self._others[origin.topic, origin.number] = None
        if len(self._others) > REMEMBERED_PUBLISHERS:
            self._others.popitem(last=False)
        return f"another publisher on '{owner.topic}' is being played: stop it and arm again"


class SpentPlans:
    """Remembers what was heard before the last arming, so that it does not go on after it."""

    def __init__(self) -> None:
        self._spent: OrderedDict[str, None] = OrderedDict()
        self._heard: OrderedDict[str, None] = OrderedDict()
        self._spent_unnamed_at: float | None = None
        self._heard_unnamed_at: float | None = None

    def hear(self, plan_id: str, now: float) -> None:
        """Note the plan of a setpoint.

        Args:
            plan_id: of the setpoint; empty for hand-typed ones.
            now: [s] steady clock.
        """
        if plan_id:
            _remember(self._heard, plan_id)
        else:
            self._heard_unnamed_at = now

    def spend(self) -> None:
        """Refuse from now on whatever has been heard until now."""
        for plan_id in self._heard:
            _remember(self._spent, plan_id)
        self._heard.clear()
        if self._heard_unnamed_at is not None:
            self._spent_unnamed_at = self._heard_unnamed_at
            self._heard_unnamed_at = None

    def refuse(self, plan_id: str, now: float) -> str:
        """Return why a plan is not taken after this arming, or nothing if it is."""
        if plan_id in self._spent:
            return "this plan was sent before the driver was armed: send a new plan"
        if not plan_id and self._spent_unnamed_at is not None:
            if now - self._spent_unnamed_at < RELEASE_TIME:
                self._spent_unnamed_at = now
                return (
                    "setpoints without a plan have gone on since before the driver was armed: "
                    f"stop them for {RELEASE_TIME:g} s"
                )
            self._spent_unnamed_at = None
        return ""


def _remember(plans: OrderedDict[str, None], plan_id: str) -> None:
    plans[plan_id] = None
    plans.move_to_end(plan_id)
    while len(plans) > REMEMBERED_PLANS:
        plans.popitem(last=False)
