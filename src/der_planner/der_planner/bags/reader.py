"""Read bags without ROS: MCAP or sqlite3, ours or rosbag2's, finished or killed.

Definitions come from the bag itself, so a bag of other machines and other versions of the messages
reads the same. Only the topics that are asked for are touched.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import Reader
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from der_planner.bags.recover import RecoverError, recover_bag
from der_planner.bags.topics import DefinitionError, find_definition
from der_planner.bags.writer import RUN_KEY


class BagError(ValueError):
    """A path is no readable bag; the message says what is wrong and what helps."""


@dataclass(frozen=True)
class RecordedTopic:
    """One topic of a bag.

    Attributes:
        name: as recorded.
        type_name: ``package/msg/Name``.
        message_count: in the whole bag.
        reliable: every publisher was; true where the bag does not say.
        latched: every publisher kept its last messages for late subscribers.
    """

    name: str
    type_name: str
    message_count: int
    reliable: bool = True
    latched: bool = False


@dataclass(frozen=True)
class RawMessage:
    """One message as recorded: log time in ns, serialized CDR."""

    topic: str
    type_name: str
    log_time: int
    data: bytes


class BagReader:
    """An open bag; a context manager.

    What is whole of a bag that was cut short or damaged is read from a recovered copy in the
    temporary folder.

    Args:
        path: a bag folder, or one ``.mcap`` or ``.db3`` file.

    Raises:
        BagError: nothing readable is there.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._stack = contextlib.ExitStack()
        if not self.path.exists():
            raise BagError(f"no bag at {self.path}")
        try:
            self._reader = self._open()
        except (RecoverError, OSError) as error:
            self._stack.close()
            raise BagError(f"cannot read the bag {self.path}: {error}") from error
        self._store = get_typestore(Stores.EMPTY)
        for connection in self._reader.connections:
            self._register(connection)

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _open(self) -> Reader:
        with contextlib.suppress(Exception):  # rosbags raises many kinds for what is not whole
            return self._stack.enter_context(Reader(self.path))
        folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="bag_")))
        recovered = recover_bag(self.path, folder / self.path.stem).folder
        return self._stack.enter_context(Reader(recovered))

    def _register(self, connection: Any) -> None:
        name, definition = connection.msgtype, connection.msgdef
        if name in self._store.types:
            return
        if definition.format == MessageDefinitionFormat.IDL:
            types = get_types_from_idl(definition.data)
        elif definition.format == MessageDefinitionFormat.MSG:
            types = get_types_from_msg(definition.data, name)
        else:
            # Sqlite3 bags of old carry no definitions: take those of this machine, if it has them.
            try:
                types = get_types_from_msg(find_definition(name).text, name)
            except DefinitionError:
                return
        self._store.register({k: v for k, v in types.items() if k not in self._store.types})

    @property
    def topics(self) -> dict[str, RecordedTopic]:
        """The bag's topics by name."""
        found: dict[str, RecordedTopic] = {}
        for name, topic in self._reader.topics.items():
            profiles = [p for each in topic.connections for p in each.ext.offered_qos_profiles]
            latched = all(p.durability.name == "TRANSIENT_LOCAL" for p in profiles)
            found[name] = RecordedTopic(
                name,
                topic.connections[-1].msgtype,
                topic.msgcount,
                reliable=all(p.reliability.name != "BEST_EFFORT" for p in profiles),
                latched=bool(profiles) and latched,
            )
        return found

    def fits_installed(self, type_name: str) -> bool:
        """Return whether a type of the bag has the fields of the one that is installed here.

        Raises:
            DefinitionError: it is not installed here.
        """
        installed = find_definition(type_name).type_hash
        return bool(self._store.hash_rihs01(type_name) == installed)

    @property
    def start(self) -> int:
        """Log time of the first message [ns]."""
        return int(self._reader.start_time)

    @property
    def end(self) -> int:
        """Log time of the last message [ns]."""
        return int(self._reader.end_time - 1)

    def run(self) -> dict[str, Any]:
        """Return what the recorder was told of the run; empty for bags of other recorders."""
        custom = self._reader.storage.metadata.custom or {}
        path = Path(self._reader.path)
        if RUN_KEY not in custom and path.suffix == ".mcap":
            with path.open("rb") as file:
                for record in make_reader(file).iter_metadata():
                    if record.name == RUN_KEY:
                        custom = record.metadata
        try:
            value = json.loads(custom.get(RUN_KEY, "") or "{}")
        except (json.JSONDecodeError, TypeError):  # no JSON, or no text at all
            return {}
        return value if isinstance(value, dict) else {}

    def raw(
        self,
        topics: Sequence[str] | None = None,
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[RawMessage]:
        """Yield messages in the order of their log times, file after file.

        Args:
            topics: names; every topic if None.
            start: first log time [ns].
            stop: log time before which to stop [ns].
        """
        wanted = [c for c in self._reader.connections if topics is None or c.topic in topics]
        if wanted:
            for connection, log_time, data in self._reader.messages(wanted, start, stop):
                yield RawMessage(connection.topic, connection.msgtype, log_time, bytes(data))

    def messages(
        self,
        topics: Sequence[str] | None = None,
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[tuple[str, int, Any]]:
        """Yield (topic, log time [ns], message) with arrays as numpy arrays; as `raw` otherwise."""
        for message in self.raw(topics, start, stop):
            yield message.topic, message.log_time, self._deserialize(message)

    def _deserialize(self, message: RawMessage) -> Any:
        try:
            return self._store.deserialize_cdr(message.data, message.type_name)
        except SerdeError:
            # rclpy's serialize_message reserves space for the alignment of empty sequences and
            # leaves it behind the content: more bytes than needed are no damage, fewer are.
            definition = self._store.get_msgdef(message.type_name)
            little = bool(message.data[1])
            read = definition.deserialize_cdr_le if little else definition.deserialize_cdr_be
            body = message.data[4:]
            content, used = read(body, 0, definition.cls, self._store)
            if used > len(body):
                raise
            return content
