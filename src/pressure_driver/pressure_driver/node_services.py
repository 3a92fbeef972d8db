"""`arm` and `vent`, served by a thread of their own: no topic, log or timer stands before them."""

from __future__ import annotations

import threading
from collections.abc import Callable

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

LONGEST_QUEUE = 1000
"""Requests that may wait; the middleware's default of 10 loses those that come at once."""
LONGEST_WAIT = 0.1
"""[s] between looks whether the driver ends."""

Answer = Callable[[], tuple[bool, str]]


class EmergencyServices:
    """Serves ``~/vent`` and ``~/arm`` of a node until it is closed.

    Of requests that wait together, one for `vent` is answered before any other for `arm`.

    Args:
        owner: the node whose services these are.
        vent, arm: what to do; each returns whether it was done, and a sentence.

    Attributes:
        error: what ended the thread, if it did not end by `close`.
    """

    def __init__(self, owner: Node, vent: Answer, arm: Answer) -> None:
        self.error: Exception | None = None
        # A node of its own, since an executor serves whole nodes. Services have the owner's names.
        self._node = Node(
            owner.get_name() + "_emergency",
            namespace=owner.get_namespace(),
            context=owner.context,
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
        )
        profile = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=LONGEST_QUEUE,
            reliability=ReliabilityPolicy.RELIABLE,
        )
        # Ready services are served in the order of their creation.
        for name, act in (("~/vent", vent), ("~/arm", arm)):
            self._node.create_service(
                Trigger, owner.resolve_service_name(name), _handler(act), qos_profile=profile
            )
        self._executor = SingleThreadedExecutor(context=owner.context)
        self._executor.add_node(self._node)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="arm and vent", daemon=True)

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()

    def close(self) -> None:
        """End the thread and withdraw the services."""
        self._stop.set()
        if self._thread.is_alive():
            self._executor.wake()
            self._thread.join(10.0 * LONGEST_WAIT)
        if not self._thread.is_alive():
            self._executor.shutdown()
            self._node.destroy_node()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._executor.spin_once(timeout_sec=LONGEST_WAIT)
        except Exception as error:
            if not self._stop.is_set():
                self.error = error


def _handler(act: Answer) -> Callable[[Trigger.Request, Trigger.Response], Trigger.Response]:
    def handle(_: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        answer.success, answer.message = act()
        return answer

    return handle
