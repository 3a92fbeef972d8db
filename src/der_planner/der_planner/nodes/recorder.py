"""The recorder: every topic of the graph into an MCAP bag, as raw CDR."""

from __future__ import annotations

import json
import re
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from std_srvs.srv import Trigger

from der_planner.bags.session import RecordingSession
from der_planner.bags.topics import DefinitionError, OfferedQos, TopicSpec, message_class
from der_planner.bags.writer import COMPRESSIONS, RUN_KEY, BagWriteError, BagWriter
from limb_interfaces import parameters, qos, topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.parameters import check_overrides
from limb_interfaces.runner import run_node

IMAGE_TYPE = "sensor_msgs/msg/Image"
DEPTH = 200
"""This many messages of a topic may wait for the node."""
IMAGE_DEPTH = 30
"""This many images of a topic may wait for the node."""


@dataclass
class _Source:
    """One topic that the recorder listens to.

    Attributes:
        spec: of the topic.
        subscription: to it.
        newest: instant of sending [ns] and content of the last message of a latched topic.
        missed: messages that were sent while a bag was recorded, and never arrived.
    """

    spec: TopicSpec
    subscription: Subscription | None = None
    newest: tuple[int, bytes] | None = None
    missed: int = 0
    _number: int = 0
    _counts: bool = False

    def lacking_before(self, number: int) -> int:
        """Return how many messages did not arrive before one, by its publisher's own count."""
        before, self._number = self._number, number
        if number <= before:
            self._counts = False  # another publisher, or the same one begins anew
        return number - before - 1 if self._counts and before else 0

    def count_again(self, publishers: int) -> None:
        """Count only where there is one publisher: messages do not tell whose number they bear."""
        if publishers == 1 and not self._counts:
            self._number = 0
        self._counts = publishers == 1


class Recorder(Node):
    """Subscribes to whatever is published, and writes it between `start` and `stop`."""

    def __init__(self) -> None:
        super().__init__("recorder", namespace=topics.NAMESPACE)
        self._declare_parameters()
        check_overrides(self)
        self._session: RecordingSession | None = None
        self._last_failure = ""
        self._last_bag = ""
        self._sources: dict[str, _Source] = {}
        self._refused: dict[str, str] = {}
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self._discover()
        self._discovery = self.create_timer(0.25, self._discover)
        self._diagnostics = DiagnosticsPublisher(self, self._health)
        if self._parameter("autostart"):
            self._start()

    def close(self) -> None:
        """Close the bag."""
        if self._session is not None:
            self._stop()

    def _declare_parameters(self) -> None:
        declare = partial(parameters.declare, self)
        folder = "bag folder that the next start makes; empty: one named by the time"
        declare("output", "", folder, read_only=False)
        stored = "JSON object stored in the next bag: motion, model, method, trial, seed, versions"
        declare("metadata", "{}", stored, read_only=False)
        declare("record_images", False, "record raw images, too", read_only=False)
        declare("autostart", False, "start recording at once")
        declare("topics", ".*", "regular expression that the full topic names must match")
        left_out = "regular expression of full topic names to leave out; empty: none"
        declare("exclude", ".*/(image_annotated|clock/.*|_.*)", left_out)
        packed = "of the bag's chunks; auto: none with images, else zstd"
        declare("compression", "auto", packed, choices=("auto", *COMPRESSIONS))
        declare("flush_interval", 1.0, "time between flushes [s]", at_least=0.05, at_most=60.0)
        declare("queue_size", 256 << 20, "bytes that may wait for the disk", at_least=1 << 20)
        declare("minimum_free", 64 << 20, "stop below so many free bytes; 0: never", at_least=0)
        self._wanted = self._pattern("topics")
        self._unwanted = self._pattern("exclude")

    def _parameter(self, name: str):
        return self.get_parameter(name).value

    def _pattern(self, name: str) -> re.Pattern[str]:
        """Return a parameter's pattern."""
        text = self._parameter(name)
        try:
            return re.compile(text)
        except re.error as error:
            raise parameters.ParameterError(
                f"parameter '{name}' is '{text}', no regular expression: {error}"
            ) from error

    # Topics

    def _discover(self) -> None:
        """Subscribe to new topics, and again to those whose publishers changed their QoS."""
        for name, types in self.get_topic_names_and_types():
            if not self._is_wanted(name, types[0]):
                self._unsubscribe(name)
                continue
            if len(types) > 1:
                self._refuse(name, f"has several types: {', '.join(types)}")
                continue
            publishers = self.get_publishers_info_by_topic(name)
            offered = offered_qos(publishers)
            source = self._sources.get(name)
            if source is not None and offered and offered != source.spec.qos:
                if _profile(source.spec) == _profile(replace(source.spec, qos=offered)):
                    source.spec = replace(source.spec, qos=offered)
                else:
                    self._unsubscribe(name)
                    source = None
            if source is None:
                self._subscribe(name, types[0], offered)
            else:
                source.count_again(len(publishers))

    def _is_wanted(self, name: str, type_name: str) -> bool:
        if type_name == IMAGE_TYPE and not self._parameter("record_images"):
            return False
        return bool(self._wanted.fullmatch(name)) and not self._unwanted.fullmatch(name)

    def _refuse(self, name: str, reason: str) -> None:
        if name not in self._refused:
            self._refused[name] = reason
            self.get_logger().warning(f"not recording {name}: {reason}")

    def _subscribe(self, name: str, type_name: str, offered: tuple[OfferedQos, ...]) -> None:
        if name in self._refused:
            return
        try:
            spec = TopicSpec.installed(name, type_name, offered)
            kind = message_class(type_name)
        except DefinitionError as error:
            self._refuse(name, str(error))
            return
        source = self._sources[name] = _Source(spec)
        source.subscription = self.create_subscription(
            kind, name, partial(self._receive, source), _profile(spec), raw=True
        )

    def _unsubscribe(self, name: str) -> None:
        source = self._sources.pop(name, None)
        if source is not None:
            self.destroy_subscription(source.subscription)

    def _receive(self, source: _Source, data: bytes, info: dict[str, int]) -> None:
        arrived = self._now()
        sent = info.get("source_timestamp", 0) or arrived
        lacking = source.lacking_before(info.get("publication_sequence_number") or 0)
        if source.spec.latched:
            source.newest = (sent, data)
        if self._session is not None:
            source.missed += lacking
            self._session.put(source.spec, arrived, sent, data)

    def _receive_waiting(self) -> None:
        """Receive what waits: on a busy machine, services may overtake earlier messages."""
        for source in self._sources.values():
            waiting, count = source.subscription, 0
            with waiting.handle:
                take = partial(waiting.handle.take_message, waiting.msg_type, waiting.raw)
                while count < DEPTH and (taken := take()):
                    self._receive(source, *taken)
                    count += 1

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _missed(self) -> dict[str, int]:
        return {name: each.missed for name, each in self._sources.items() if each.missed}

    # Services

    def _start(self) -> str:
        self._receive_waiting()
        metadata = self._run_metadata()
        output = self._parameter("output")
        folder = Path(output) if output else Path(time.strftime("bag_%Y_%m_%d-%H_%M_%S"))
        compression = self._parameter("compression")
        if compression == "auto":
            compression = "none" if self._parameter("record_images") else "zstd"
        writer = BagWriter(
            folder.absolute(),
            {RUN_KEY: metadata},
            compression=compression,
            minimum_free=self._parameter("minimum_free"),
        )
        self._session = RecordingSession(
            writer,
            flush_interval=self._parameter("flush_interval"),
            queue_bytes=self._parameter("queue_size"),
            on_failure=self.get_logger().error,
        )
        self._last_failure = ""
        self._discover()
        now = self._now()
        for source in self._sources.values():
            source.missed = 0
            if source.newest is not None:
                self._session.put(source.spec, now, *source.newest)
        self.get_logger().info(f"recording into {writer.folder}")
        return str(writer.folder)

    def _run_metadata(self) -> str:
        text = self._parameter("metadata")
        try:
            value = json.loads(text or "{}")
        except json.JSONDecodeError as error:
            raise parameters.ParameterError(f"parameter 'metadata' is no JSON: {error}") from error
        if not isinstance(value, dict):
            raise parameters.ParameterError("parameter 'metadata' must be a JSON object: {…}")
        return json.dumps(value)

    def _stop(self) -> tuple[bool, str]:
        assert self._session is not None
        self._receive_waiting()
        ended, self._session = self._session, None
        ended.stop()
        self._last_failure = ended.failure
        self._last_bag = str(ended.writer.folder)
        if ended.failure:
            return False, ended.failure
        self.get_logger().info(
            f"closed {self._last_bag}: {ended.writer.message_count} messages, {ended.dropped} "
            f"dropped, {sum(self._missed().values())} missed"
        )
        return True, self._last_bag

    def _on_start(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._session is not None and not self._session.failure:
            folder = self._session.writer.folder
            response.message = f"already recording into {folder}: stop that first"
            return response
        if self._session is not None:
            self._stop()
        try:
            response.message = self._start()
            response.success = True
        except (BagWriteError, parameters.ParameterError) as error:
            response.message = self._last_failure = str(error)
            self.get_logger().error(str(error))
        return response

    def _on_stop(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._session is None:
            response.message = self._last_failure or "not recording: start a recording first"
            return response
        response.success, response.message = self._stop()
        return response

    def _health(self) -> Health:
        values: dict[str, object] = {
            "topics": len(self._sources),
            "missed": "; ".join(f"{name}: {count}" for name, count in self._missed().items()),
            "not_recorded": "; ".join(f"{k}: {v}" for k, v in self._refused.items()),
        }
        if self._session is None:
            values["bag"] = self._last_bag
            if self._last_failure:
                return Health("error", self._last_failure, {**values, "state": "failed"})
            return Health("ok", "not recording", {**values, "state": "idle"})
        session, bag = self._session, self._session.writer
        values |= {
            "state": "recording",
            "bag": bag.folder,
            "recorded": bag.message_count,
            "bytes": bag.byte_count,
            "dropped": session.dropped,
            "queued_bytes": session.queued_bytes,
        }
        if session.failure:
            return Health("error", session.failure, {**values, "state": "failed"})
        if session.dropped:
            lost = f"{session.dropped} messages dropped: the disk is too slow for what is recorded"
            return Health("warning", lost, values)
        if values["missed"]:
            return Health("warning", f"messages that never arrived, {values['missed']}", values)
        return Health("ok", f"recording into {bag.folder}", values)


def offered_qos(endpoints: list[TopicEndpointInfo]) -> tuple[OfferedQos, ...]:
    """Return what the publishers of a topic offer, each profile once."""
    found = {
        OfferedQos(
            reliability=info.qos_profile.reliability.name.lower(),
            durability=info.qos_profile.durability.name.lower(),
            history=info.qos_profile.history.name.lower(),
            depth=info.qos_profile.depth,
        )
        for info in endpoints
    }
    return tuple(sorted(found, key=repr))


def _profile(spec: TopicSpec) -> QoSProfile:
    """Return the strictest profile that every publisher still matches."""
    is_image = spec.type_name == IMAGE_TYPE
    reliable = not is_image and all(q.reliability == "reliable" for q in spec.qos)
    return qos.profile(IMAGE_DEPTH if is_image else DEPTH, reliable, spec.kept)


def main() -> int:
    """Run the node."""
    return run_node(Recorder)
