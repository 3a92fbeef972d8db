"""Whose setpoints are taken: one publisher at a time, and plans of this arming only.

A publisher is told by the numbers that it counts its messages with: the middleware of ROS 2 Jazzy
hands these to a node, and not the publisher's identity. Publishers that count in step cannot be
told apart; then none of them is taken.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

RELEASE_TIME = 1.0
"""[s] of silence after which another publisher, or hand-typed setpoints again, are taken."""
IN_STEP = 0.3
"""[s] since the publisher that is played was heard, after which the next number is not its own if
another publisher has just sent the one before."""
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


class SourceGate:
    """Keeps to one publisher until it has been silent for `RELEASE_TIME`."""

    def __init__(self) -> None:
        self.refused = 0
        """Setpoints of a second publisher."""
        self._active: Origin | None = None
        self._heard_at = 0.0
        self._mixed_at: float | None = None
        self._others: OrderedDict[tuple[str, int], float] = OrderedDict()

    def refuse(self, origin: Origin, now: float) -> str:
        """Return why a setpoint from there is not taken, or nothing if it is.

        Args:
            origin: of the setpoint.
            now: [s] steady clock.
        """
        reason = self._judge(origin, now)
        if reason:
            self.refused += 1
        return reason

    def _judge(self, origin: Origin, now: float) -> str:
        mixed = self._mixed_at is not None and now - self._mixed_at < RELEASE_TIME
        if mixed and not origin.alone:
            self._mixed_at = now
            return (
                "two publishers send setpoints in step and cannot be told apart: stop both for "
                f"{RELEASE_TIME:g} s, then start one"
            )
        self._mixed_at = None
        active = self._active
        if active is None or now - self._heard_at >= RELEASE_TIME:
            self._others.clear()
            return self._take(origin, now)
        before = (origin.topic, origin.number - 1)
        continues = origin.topic == active.topic and origin.number == active.number + 1
        if continues and not (before in self._others and now - self._heard_at > IN_STEP):
            if before in self._others:
                self._active, self._mixed_at = None, now
                self._others.clear()
                return "two publishers send setpoints, and which is which cannot be told: stop one"
            return self._take(origin, now)
        if origin.alone and origin.topic == active.topic:
            return self._take(origin, now)  # messages were lost, or the publisher has started anew
        self._others.pop(before, None)
        self._others[origin.topic, origin.number] = now
        while len(self._others) > REMEMBERED_PUBLISHERS:
            self._others.popitem(last=False)
        return (
            f"another publisher on '{active.topic}' is being played: stop it, and wait "
            f"{RELEASE_TIME:g} s"
        )

    def _take(self, origin: Origin, now: float) -> str:
        self._active, self._heard_at = origin, now
        return ""


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
