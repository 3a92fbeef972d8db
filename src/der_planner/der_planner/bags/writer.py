"""Write a bag as rosbag2 lays it out: raw CDR in an MCAP file with embedded definitions.

rosbag2's own writer keeps a chunk open until it is full; here every `flush` ends the chunk and
hands it to the operating system, so a killed process leaves whole chunks. A bag whose writing was
cut short has no index and no ``metadata.yaml``: `recover` makes a whole bag of it.
``metadata.yaml`` (version 9, Jazzy) lists files and topics; ``ros2 bag info`` and ``ros2 bag play``
read it first. Field names and their meaning: rosbag2's ``BagMetadata``.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Schema
from mcap.writer import CompressionType, Writer

from der_planner.bags.topics import TopicSpec

COMPRESSIONS = {kind.name.lower(): kind for kind in CompressionType}
METADATA_FILE = "metadata.yaml"
RUN_KEY = "run"
"""Name of the MCAP metadata record, and of the custom-data entry, that holds the run's JSON."""
CHUNK_SIZE = 1 << 20
"""A chunk holds at most this before it is compressed [bytes]."""
LARGE = 1 << 17
"""Messages of so many bytes get a chunk of their own, so that whoever reads only the small ones
does not have to read the images between them."""
REPEATS = 3
"""A topic's definition is repeated outside of chunks at so many flushes after its first message."""
PROFILE = "ros2"
LIBRARY = "der_planner recorder"
_Message = tuple[int, bytes, int, int]
"""Log time [ns], content, publish time [ns] and number, as `mcap.writer.Writer` takes them."""


class BagWriteError(OSError):
    """The bag cannot be written any further; the message says why and what is left of it."""


@dataclass
class _Topic:
    """What of a topic is in the bag.

    Attributes:
        spec: of the topic.
        count: messages that were written.
        channel: of the topic, from its first message in the file on.
        repeats: at so many flushes to come its definition is repeated.
    """

    spec: TopicSpec
    count: int = 0
    channel: Channel | None = None
    repeats: int = REPEATS


class BagWriter:
    """A bag folder that is being written.

    Args:
        folder: the bag; made here, must not exist yet or be empty.
        custom_data: strings kept in the bag and in ``metadata.yaml``.
        compression: of chunks: ``none``, ``lz4`` or ``zstd``.
        minimum_free: close the bag when the disk has fewer free bytes; 0 = do not look.

    Raises:
        BagWriteError: the folder exists with something in it, cannot be made, or lies on a disk
            with too little space.
    """

    def __init__(
        self,
        folder: Path,
        custom_data: Mapping[str, str] | None = None,
        *,
        compression: str = "zstd",
        minimum_free: int = 0,
    ) -> None:
        self.folder = Path(folder)
        self.custom_data = dict(custom_data or {})
        packed = COMPRESSIONS[compression]
        self._minimum_free = minimum_free
        self._topics: dict[str, _Topic] = {}
        self._name = f"{self.folder.name}_0.mcap"
        self._first, self._last = 0, 0
        self._small: list[tuple[_Topic, _Message]] = []
        self._small_bytes = 0
        self._schemas: dict[str, Schema] = {}
        self.byte_count = 0
        """Bytes in the file; what waits for the next flush is not counted."""
        self._closed = False
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if any(self.folder.iterdir()):
                raise BagWriteError(f"the bag folder {self.folder} is not empty: name another one")
            if self._lacks_space():
                raise BagWriteError(f"{self._too_little()}: nothing is recorded")
            self._file = (self.folder / self._name).open("xb")
            self._writer = Writer(self._file, chunk_size=CHUNK_SIZE, compression=packed)
            self._writer.start(profile=PROFILE, library=LIBRARY)
            if self.custom_data:
                self._writer.add_metadata(RUN_KEY, self.custom_data)
            self._file.flush()
        except BagWriteError:
            raise
        except OSError as error:
            raise BagWriteError(f"cannot write a bag into {self.folder}: {error}") from error

    @property
    def message_count(self) -> int:
        """Messages written."""
        return sum(topic.count for topic in list(self._topics.values()))

    def write(self, spec: TopicSpec, log_time: int, publish_time: int, data: bytes) -> None:
        """Append one message.

        Args:
            spec: its topic; of topics of one name the first counts.
            log_time: when it arrived [ns].
            publish_time: when it was sent [ns].
            data: serialized CDR with its four-byte header.

        Raises:
            BagWriteError: the storage refused; the bag stays as it is, without an index.
        """
        self._first = min(self._first, log_time) if self._topics else log_time
        self._last = max(self._last, log_time)
        topic = self._topics.setdefault(spec.name, _Topic(spec))
        message = (log_time, data, publish_time, topic.count & 0xFFFFFFFF)
        topic.count += 1
        with self._guarded():
            if len(data) >= LARGE:
                self._emit(topic, message)
                self._end_chunk()
                return
            self._small.append((topic, message))
            self._small_bytes += len(data)
            if self._small_bytes >= CHUNK_SIZE:
                self._emit_small()

    def flush(self) -> None:
        """End the chunk and hand everything to the operating system.

        Raises:
            BagWriteError: as `write`, or the bag's folder was removed meanwhile, or the disk has
                too little space left; in that last case the bag was closed and is whole.
        """
        with self._guarded():
            self._emit_small()
            self._repeat_definitions()
        if not (self.folder / self._name).exists():
            self._abandon()
            raise BagWriteError(
                f"the bag {self.folder} was removed while it was recorded: what it held is lost"
            )
        if self._lacks_space():
            self.close()
            raise BagWriteError(
                f"{self._too_little()}: recording stopped, the bag is closed and complete up to "
                "here. Free some space and start again"
            )

    def close(self) -> Path:
        """Finish the bag and return its folder; may be called twice.

        Raises:
            BagWriteError: as `write`.
        """
        if not self._closed:
            with self._guarded():
                self._emit_small()
                self._writer.finish()
                self.byte_count = self._file.tell()
                self._file.close()
                self._write_metadata()
            self._closed = True
        return self.folder

    def _emit_small(self) -> None:
        """Write the small messages that wait, as one chunk."""
        for message in self._small:
            self._emit(*message)
        self._small.clear()
        self._small_bytes = 0
        self._end_chunk()

    def _end_chunk(self) -> None:
        self._writer.flush()
        self.byte_count = self._file.tell()

    def _emit(self, topic: _Topic, message: _Message) -> None:
        topic.channel = topic.channel or self._registered(topic.spec)
        self._writer.add_message(topic.channel.id, *message)

    def _registered(self, spec: TopicSpec) -> Channel:
        if spec.type_name not in self._schemas:
            text = spec.definition.encode()
            number = self._writer.register_schema(spec.type_name, spec.encoding, text)
            self._schemas[spec.type_name] = Schema(number, text, spec.encoding, spec.type_name)
        about = {"offered_qos_profiles": spec.qos_yaml(), "topic_type_hash": spec.type_hash}
        schema = self._schemas[spec.type_name].id
        number = self._writer.register_channel(spec.name, "cdr", schema, about)
        return Channel(number, spec.name, "cdr", about, schema)

    def _repeat_definitions(self) -> None:
        """Write what is known of young topics again, outside of chunks.

        A topic's schema and channel lie in the chunk of its first message: if that chunk were
        damaged, nobody could read the others.
        """
        records = RecordBuilder()
        for topic in self._topics.values():
            if topic.channel is not None and topic.repeats > 0:
                self._schemas[topic.spec.type_name].write(records)
                topic.channel.write(records)
                topic.repeats -= 1
        self._file.write(records.end())
        self._end_chunk()

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        """Turn a refused write into a BagWriteError."""
        try:
            yield
        except OSError as error:
            self._abandon()
            raise BagWriteError(
                f"recording into {self.folder} stopped: {error}. Free some space, then "
                f"scripts/recover_bag.py {self.folder} saves what was written"
            ) from error

    def _abandon(self) -> None:
        """Leave the bag as it is."""
        self._closed = True
        with contextlib.suppress(OSError):
            self._file.close()

    def _lacks_space(self) -> bool:
        return shutil.disk_usage(self.folder).free < self._minimum_free

    def _too_little(self) -> str:
        return f"fewer than {self._minimum_free >> 20} MiB are free where {self.folder} lies"

    def _write_metadata(self) -> None:
        """Write ``metadata.yaml``, whole or not at all; a folder that was removed stays so."""
        text = yaml.safe_dump({"rosbag2_bagfile_information": self._metadata()}, sort_keys=False)
        unfinished = self.folder / f".{METADATA_FILE}.part"
        unfinished.write_text(text, encoding="utf-8")
        unfinished.replace(self.folder / METADATA_FILE)

    def _metadata(self) -> dict[str, Any]:
        content = {
            "duration": {"nanoseconds": self._last - self._first},
            "starting_time": {"nanoseconds_since_epoch": self._first},
            "message_count": self.message_count,
        }
        return {
            "version": 9,
            "storage_identifier": "mcap",
            **content,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.spec.name,
                        "type": topic.spec.type_name,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": [each.as_mapping() for each in topic.spec.qos],
                        "type_description_hash": topic.spec.type_hash,
                    },
                    "message_count": topic.count,
                }
                for topic in self._topics.values()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self._name],
            "files": [{"path": self._name, **content}],
            "custom_data": self.custom_data,
            "ros_distro": "jazzy",
        }
