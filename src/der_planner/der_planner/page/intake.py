"""Topics that the page looks into at its own pace, so that no message wakes rclpy's executor.

The executor gathers everything that it waits for anew after each message, which costs more than the
message itself; the page needs what came no sooner than it draws.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

PERIOD = 0.025
"""[s] between two looks: short against the 0.1 s of the live data and the 66 ms of the pictures."""
MOST = 100
"""Messages of a topic taken at one look, so that a flood of one leaves time for the others."""


class _Unwoken(CallbackGroup):  # type: ignore[misc]  # rclpy is not typed
    """Keeps subscriptions out of what the executor waits for."""

    def can_execute(self, entity: object) -> bool:  # noqa: ARG002
        return False

    def beginning_execution(self, entity: object) -> bool:  # noqa: ARG002
        return False

    def ending_execution(self, entity: object) -> None:
        pass


_NO_EVENTS = SubscriptionEventCallbacks(use_default_callbacks=False)
"""Waiting for a subscription's warnings would wake the executor with each of its messages, too."""


class Intake:
    """Takes all messages of several topics that have come, every `PERIOD`, in a thread of its own.

    A message that a callback cannot take, as one of another program may be, is reported and left
    out: it must not end the page and its vent.

    Args:
        node: that subscribes.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.refused = 0
        """Messages left out."""
        self.last_refused = ""
        """Topic and reason of the newest of them."""
        self._group = _Unwoken()
        self._lock = threading.Lock()
        self._subscriptions: list[Subscription] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="intake", daemon=True)
        self.error: Exception | None = None
        """What ended the looking."""

    def subscribe(
        self,
        kind: type,
        topic: str,
        callback: Callable[[Any], None],
        profile: QoSProfile,
        raw: bool = False,
    ) -> Subscription:
        """Subscribe as the node's own `create_subscription` would; ``raw`` gives bytes."""
        subscription = self._node.create_subscription(
            kind,
            topic,
            callback,
            profile,
            callback_group=self._group,
            event_callbacks=_NO_EVENTS,
            raw=raw,
        )
        with self._lock:
            self._subscriptions.append(subscription)
        return subscription

    def remove(self, subscription: Subscription) -> None:
        """End a subscription."""
        with self._lock:
            self._subscriptions.remove(subscription)
        self._node.destroy_subscription(subscription)

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def close(self) -> None:
        """Look no more; before the node is destroyed."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        try:
            while not self._stop.wait(PERIOD):
                with self._lock:
                    self._look()
        except Exception as error:  # the node must hear of it
            self.error = error

    def _look(self) -> None:
        for subscription in self._subscriptions:
            for _ in range(MOST):
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                if taken is None:
                    break
                try:
                    subscription.callback(taken[0])
                except Exception as error:  # whatever is wrong with the message
                    self._refuse(subscription.topic_name, error)

    def _refuse(self, topic: str, error: Exception) -> None:
        self.refused += 1
        self.last_refused = f"a message of {topic} could not be used: {error}"
        self._node.get_logger().error(self.last_refused, throttle_duration_sec=10.0)
