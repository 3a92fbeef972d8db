"""Read bags without ROS: MCAP or sqlite3, ours or rosbag2's, finished or killed.

Definitions come from the bag itself, so a bag of other machines and other versions of the messages
reads the same. Only the topics that are asked for are touched.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from der_planner.bags.layout import METADATA_FILE, RUN_KEY
from der_planner.bags.recover import copy_finished
from der_planner.bags.scan import RecoverError, bag_files, parse_run, scan_file


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

    Args:
        path: a bag folder, or one ``.mcap`` or ``.db3`` file.

    Raises:
        BagError: nothing readable is there.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._stack = contextlib.ExitStack()
        self.unfinished = False
        if not self.path.exists():
            raise BagError(f"no bag at {self.path}")
        try:
            self._readers = [self._stack.enter_context(reader) for reader in self._open()]
        except (ReaderError, RecoverError, OSError, AssertionError) as error:
            self._stack.close()
            raise BagError(
                f"cannot read the bag {self.path}: {error}. If its recorder was killed, "
                f"scripts/recover_bag.py {self.path} repairs it"
            ) from error
        self._store = get_typestore(Stores.EMPTY)
        self._known: set[str] = set()
        for reader in self._readers:
            for connection in reader.connections:
                self._register(connection)

    def __enter__(self) -> BagReader:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.close()

    def _open(self) -> list[Reader]:
        """Return readers of the bag's parts; unfinished files are read from a finished copy."""
        whole = self.path.is_file() or (self.path / METADATA_FILE).exists()
        if whole:
            with contextlib.suppress(ReaderError):
                reader = Reader(self.path)
                reader.open()
                reader.close()
                return [Reader(self.path)]
        if self.path.suffix == ".db3":
            return [Reader(self.path)]
        self.unfinished = True
        readers = []
        for file in bag_files(self.path):
            if scan_file(file).complete:
                readers.append(Reader(file))
                continue
            folder = self._stack.enter_context(tempfile.TemporaryDirectory(prefix="bag_"))
            readers.append(Reader(copy_finished(file, Path(folder) / file.name)))
        return readers

    def _register(self, connection: Any) -> None:
        if connection.msgtype in self._known:
            return
        definition = connection.msgdef
        if definition.format == MessageDefinitionFormat.NONE:
            self._register_from_installation(connection.msgtype)
            return
        parse = (
            (lambda text, _: get_types_from_idl(text))
            if definition.format == MessageDefinitionFormat.IDL
            else get_types_from_msg
        )
        types = parse(definition.data, connection.msgtype)
        self._store.register({k: v for k, v in types.items() if k not in self._known})
        self._known.update(types)

    def _register_from_installation(self, type_name: str) -> None:
        """Sqlite3 bags of old carry no definitions: take those of this machine, if it has them."""
        from der_planner.bags.definitions import (  # noqa: PLC0415 - rarely needed
            DefinitionError,
            find_definition,
        )

        with contextlib.suppress(DefinitionError):
            types = get_types_from_msg(find_definition(type_name).text, type_name)
            self._store.register({k: v for k, v in types.items() if k not in self._known})
            self._known.update(types)

    @property
    def topics(self) -> dict[str, RecordedTopic]:
        """The bag's topics by name."""
        found: dict[str, RecordedTopic] = {}
        for reader in self._readers:
            for connection in reader.connections:
                name, count = connection.topic, connection.msgcount
                if name in found:
                    count += found[name].message_count
                profiles = getattr(connection.ext, "offered_qos_profiles", [])
                found[name] = RecordedTopic(
                    name,
                    connection.msgtype,
                    count,
                    reliable=all(p.reliability.name != "BEST_EFFORT" for p in profiles),
                    latched=bool(profiles)
                    and all(p.durability.name == "TRANSIENT_LOCAL" for p in profiles),
                )
        return found

    @property
    def start(self) -> int:
        """Log time of the first message [ns]."""
        return int(min(reader.start_time for reader in self._readers))

    @property
    def end(self) -> int:
        """Log time of the last message [ns]."""
        return int(max(reader.end_time - 1 for reader in self._readers))

    def run(self) -> dict[str, Any]:
        """Return what the recorder was told of the run; empty for bags of other recorders."""
        if self.path.is_dir() and (self.path / METADATA_FILE).exists():
            document = yaml.safe_load((self.path / METADATA_FILE).read_text()) or {}
            custom = document.get("rosbag2_bagfile_information", {}).get("custom_data") or {}
            if RUN_KEY in custom:
                return parse_run(custom)
        with contextlib.suppress(RecoverError):
            for file in bag_files(self.path):
                if file.suffix == ".mcap" and (custom := _leading_metadata(file)):
                    return parse_run(custom)
        return {}

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
        for reader in self._readers:
            wanted = [c for c in reader.connections if topics is None or c.topic in topics]
            if not wanted:
                continue
            for connection, log_time, data in reader.messages(wanted, start, stop):
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


def _leading_metadata(path: Path) -> dict[str, str]:
    """Read the metadata record that the recorder writes at the start of a file."""
    from mcap.records import Metadata  # noqa: PLC0415 - only for bags without metadata.yaml
    from mcap.stream_reader import StreamReader  # noqa: PLC0415

    with path.open("rb") as file:
        try:
            for count, record in enumerate(StreamReader(file, emit_chunks=True).records):
                if isinstance(record, Metadata) and record.name == RUN_KEY:
                    return dict(record.metadata)
                if count > 2:
                    break
        except Exception:  # whatever a damaged file makes of the parser: no description then
            return {}
    return {}
