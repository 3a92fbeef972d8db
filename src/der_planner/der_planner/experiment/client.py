"""A client of the graph: what the orchestrator and the tests see of it and ask of it."""

from __future__ import annotations

import contextlib
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from der_planner.experiment.processes import GraphError, NodeProcess
from limb_interfaces import qos, topics

READY = (DiagnosticStatus.OK, DiagnosticStatus.WARN)


PATIENCE = 120.0
"""Longest time [s] until a node is ready, e.g. while its kernels compile at the first start."""
FAILING = 25.0
"""Longest time [s] until a node is ready that says that something is wrong."""


class GraphClient:
    """A node of its own context that keeps the newest message of each watched topic.

    Nothing runs in the background: callbacks are served while one of the waiting methods runs, and
    all of them watch the processes given to `watch` and raise when one of them has died.

    Args:
        name: of the node.
        domain_id: ROS domain; the environment's if None.
    """

    def __init__(self, name: str = "orchestrator", domain_id: int | None = None) -> None:
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain_id, args=[])
        self.node = Node(
            name, namespace=topics.NAMESPACE, context=self._context, use_global_arguments=False
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._processes: list[NodeProcess] = []
        self.diagnostics: dict[str, DiagnosticStatus] = {}
        self.newest: dict[str, Any] = {}
        self.node.create_subscription(
            DiagnosticArray, topics.DIAGNOSTICS, self._keep_diagnostics, qos.STATES
        )

    def __enter__(self) -> GraphClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the graph."""
        with contextlib.suppress(Exception):
            self._executor.shutdown()
            self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def _keep_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            space, _, name = status.name.rpartition("/")
            if space == f"/{topics.NAMESPACE}":  # another limb has nodes of the same names
                self.diagnostics[name] = status

    def watch(self, processes: Iterable[NodeProcess]) -> None:
        """Raise from every waiting method as soon as one of these processes has ended."""
        self._processes = list(processes)

    def subscribe(
        self,
        kind: type,
        topic: str,
        profile: QoSProfile,
        callback: Callable[[Any], None] | None = None,
    ) -> None:
        """Keep a topic's newest message in ``newest[topic]``; pass each to ``callback``."""

        def keep(message: Any) -> None:
            self.newest[topic] = message
            if callback is not None:
                callback(message)

        self.node.create_subscription(kind, topic, keep, profile)

    def spin(self, seconds: float) -> None:
        """Serve callbacks for a while."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=min(left, 0.05))

    def wait_for(self, condition: Callable[[], Any], timeout: float, what: str) -> Any:
        """Serve callbacks until ``condition()`` is true, and return its value.

        Args:
            condition: looked at after every callback.
            timeout: [s].
            what: completes the sentence "waited … s for …".

        Raises:
            GraphError: the time is over.
            NodeError: a watched process has ended.
        """
        end = time.monotonic() + timeout
        while not (value := condition()):
            for process in self._processes:
                process.check()
            if time.monotonic() > end:
                raise GraphError(f"waited {timeout:.0f} s for {what}")
            self._executor.spin_once(timeout_sec=0.05)
        return value

    def wait_ready(
        self, names: Iterable[str], patience: float = PATIENCE, failing: float = FAILING
    ) -> None:
        """Wait until the diagnostics of all these nodes are ok or warning.

        Args:
            names: of the nodes.
            patience: with all of them [s].
            failing: with a node that says that something is wrong [s].

        Raises:
            GraphError: names the node that is not ready and what it says.
            NodeError: a watched process has ended.
        """
        begin, unready = time.monotonic(), set(names)

        def all_ready() -> bool:
            for name in list(unready):
                status = self.diagnostics.get(name)
                if status is not None and status.level in READY:
                    unready.remove(name)
                    continue
                bad = status is not None and status.level == DiagnosticStatus.ERROR
                limit = failing if bad else patience
                if time.monotonic() - begin > limit:
                    said = status.message if status is not None else "nothing"
                    raise GraphError(
                        f"node '{name}' was not ready within {limit:.0f} s; it says: "
                        f"{said}. On a busy machine, end what else runs, and start again"
                    )
            return not unready

        self.wait_for(all_ready, math.inf, "the nodes")

    def diagnostic_values(self, name: str) -> dict[str, str]:
        """Return the key-value pairs of a node's newest diagnostics, empty before the first."""
        status = self.diagnostics.get(name)
        return {} if status is None else {pair.key: pair.value for pair in status.values}

    def ask(self, kind: Any, service: str, timeout: float = 20.0, **request: Any) -> Any:
        """Call a service and return its response.

        Args:
            kind: class of the service.
            service: its name, e.g. ``recorder/set_parameters``.
            timeout: for the service, and then for its answer [s].
            request: fields of the request.

        Raises:
            GraphError: there is no such service, or no answer.
        """
        client = self.node.create_client(kind, service)
        self.wait_for(client.service_is_ready, timeout, f"the service {service}")
        future = client.call_async(kind.Request(**request))
        self.wait_for(future.done, timeout, f"an answer of the service {service}")
        self.node.destroy_client(client)
        return future.result()

    def call(self, service: str, timeout: float = 20.0) -> str:
        """Call a std_srvs/Trigger service, e.g. ``pressure_driver/arm``; return its message.

        Raises:
            GraphError: there is no such service, no answer, or the answer is a refusal.
        """
        answer = self.ask(Trigger, service, timeout)
        if not answer.success:
            raise GraphError(f"{service} was refused: {answer.message}")
        return str(answer.message)

    def count_nodes(self) -> Counter[str]:
        """Return how many nodes of each name the graph's namespace has, as far as is known by now.

        A node that has just started learns of the others within tenths of a second; on a busy
        machine, or over a network that loses messages, it can take seconds.
        """
        found = self.node.get_node_names_and_namespaces()
        return Counter(name for name, space in found if space == f"/{topics.NAMESPACE}")
