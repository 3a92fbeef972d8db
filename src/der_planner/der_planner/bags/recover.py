"""Save what a killed recorder, a full disk or a damaged disk left of a bag, in a new bag.

An MCAP file is a sequence of records between two magic numbers; messages lie in chunks that carry
checksums, and the index at the end only helps to find them (https://mcap.dev/spec). Every chunk
that is whole is read, wherever it lies, and its messages are written again. The source is only
read.
"""

from __future__ import annotations

import contextlib
import mmap
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk

from der_planner.bags.topics import TopicSpec, parse_qos
from der_planner.bags.writer import METADATA_FILE, RUN_KEY, BagWriter

MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_LENGTH = struct.Struct("<Q")
_CHUNK = re.compile(rb"\x06.{6}\0\0.{28}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd)", re.DOTALL)
"""What a chunk begins with: opcode, length, two times, size, checksum, name of the compression."""
_DEFINITIONS = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
}


class RecoverError(ValueError):
    """A file is no bag or holds nothing that can be saved."""


@dataclass(frozen=True)
class Recovery:
    """What was found in a bag, and where it was saved.

    Attributes:
        source: the bag, which is as it was.
        folder: the new bag; None where the source is whole and nothing was written.
        message_count: that could be read.
        damaged_chunks: whose checksum or content is wrong; their messages are lost.
        lost_bytes: in damaged chunks and in what is no record.
        unnamed: messages that could be read, but whose topic nothing in the file tells.
        duration: from the first to the last message [s].
    """

    source: Path
    folder: Path | None
    message_count: int
    damaged_chunks: int
    lost_bytes: int
    unnamed: int
    duration: float


class _Record(NamedTuple):
    opcode: int
    begin: int
    end: int


class _File:
    """One MCAP file that is read as far as it is whole; what is not is counted."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.finished = False
        self.compression = "zstd"
        self.custom_data: dict[str, str] = {}
        self.damaged_chunks = self.lost_bytes = self.unnamed = 0
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        with path.open("rb") as file:
            is_empty = path.stat().st_size == 0
            self._data = b"" if is_empty else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        closing = len(MAGIC) if self._data[-len(MAGIC) :] == MAGIC else 0
        self._end = len(self._data) - closing
        self._read_definitions()

    def _read_definitions(self) -> None:
        """Read what stands outside of the chunks: it may tell what a damaged chunk had told."""
        for record in self._records():
            if record.opcode in _DEFINITIONS:
                # Whatever the parser makes of damaged bytes: there are more records.
                with contextlib.suppress(Exception):
                    self._learn(_DEFINITIONS[record.opcode].read(self._stream(record)))
            elif record.opcode == Opcode.FOOTER:
                self.finished = record.end == self._end < len(self._data)

    def messages(
        self, progress: Callable[[float], None] | None = None
    ) -> Iterator[tuple[TopicSpec, Message]]:
        """Yield what can be read, in the order of the file.

        Args:
            progress: called with the fraction read.
        """
        specs: dict[int, TopicSpec] = {}
        self.damaged_chunks = self.lost_bytes = self.unnamed = 0
        for record in self._records(count=True):
            for message in self._messages_of(record):
                channel = self._channels.get(message.channel_id)
                if channel is None or channel.schema_id not in self._schemas:
                    self.unnamed += 1
                    continue
                if channel.id not in specs:
                    specs[channel.id] = _topic_spec(channel, self._schemas[channel.schema_id])
                yield specs[channel.id], message
            if progress is not None:
                progress(record.end / len(self._data))

    def _messages_of(self, record: _Record) -> list[Message]:
        """Return the messages of a record, none of a damaged chunk."""
        if record.opcode == Opcode.MESSAGE:
            return [Message.read(self._stream(record), record.end - record.begin)]
        if record.opcode != Opcode.CHUNK:
            return []
        try:
            chunk = Chunk.read(self._stream(record))
            found = breakup_chunk(chunk, validate_crc=True)
        except Exception:  # whatever a decompressor or parser makes of damaged bytes
            self.damaged_chunks += 1
            self.lost_bytes += record.end - record.begin
            return []
        self.compression = chunk.compression or "none"
        for each in found:
            self._learn(each)
        return [each for each in found if isinstance(each, Message)]

    def _learn(self, record: object) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif isinstance(record, Metadata) and record.name == RUN_KEY:
            self.custom_data = dict(record.metadata)

    def _records(self, count: bool = False) -> Iterator[_Record]:
        """Yield the records; where the bytes are none, go on at the next chunk.

        Args:
            count: count the bytes between as lost.
        """
        place = len(MAGIC) if self._data[: len(MAGIC)] == MAGIC else 0
        while place < self._end:
            record = self._record_at(place)
            if record is not None:
                yield record
                place = record.end
                continue
            found = _CHUNK.search(self._data, place + 1)
            after = found.start() if found else self._end
            self.lost_bytes += (after - place) * count
            place = after

    def _record_at(self, place: int) -> _Record | None:
        """Return the record that begins at a byte; None if the bytes there are no record."""
        try:
            opcode, length = _HEAD.unpack_from(self._data, place)
            record = _Record(opcode, place + _HEAD.size, place + _HEAD.size + length)
            if opcode == Opcode.CHUNK:  # the lengths inside must fit its own
                name_length = _CHUNK_HEAD.unpack_from(self._data, record.begin)[-1]
                content = record.begin + _CHUNK_HEAD.size + name_length + _LENGTH.size
                if (
                    content + _LENGTH.unpack_from(self._data, content - _LENGTH.size)[0]
                    != record.end
                ):
                    return None
        except struct.error:  # the file ends before
            return None
        return record if 0 < opcode <= max(Opcode) and record.end <= len(self._data) else None

    def _stream(self, record: _Record) -> ReadDataStream:
        return ReadDataStream(BytesIO(self._data[record.begin : record.end]))


def _topic_spec(channel: Channel, schema: Schema) -> TopicSpec:
    return TopicSpec(
        name=channel.topic,
        type_name=schema.name,
        definition=schema.data.decode(),
        type_hash=channel.metadata.get("topic_type_hash", ""),
        qos=parse_qos(channel.metadata.get("offered_qos_profiles", "")),
        encoding=schema.encoding,
    )


def bag_files(path: Path) -> list[Path]:
    """Return the MCAP files of a bag in the order of their numbers.

    Raises:
        RecoverError: there are none.
    """
    if path.is_file():
        return [path]
    found = sorted(path.glob("*.mcap"), key=_file_number)
    if not found:
        raise RecoverError(f"{path} holds no MCAP file")
    return found


def _file_number(path: Path) -> tuple[int, str]:
    tail = path.stem.rsplit("_", 1)[-1]
    return (int(tail) if tail.isdigit() else 0, path.name)


def recover_bag(
    path: Path, folder: Path | None = None, progress: Callable[[float], None] | None = None
) -> Recovery:
    """Write every message of a bag that can be read into a new bag.

    Args:
        path: folder of the bag or an MCAP file; it is only read.
        folder: of the new bag; if None, PATH_recovered, and nothing is written for a whole bag.
        progress: called with the fraction of the present file.

    Raises:
        RecoverError: there is no MCAP file, or no message whose topic is known.
        BagWriteError: the new bag cannot be written: its folder is there already, or no space.
        OSError: the bag cannot be read.
    """
    path = Path(path)
    files = [_File(file) for file in bag_files(path)]
    has_index = all(file.finished for file in files)
    if folder is None and has_index and (path.is_file() or (path / METADATA_FILE).exists()):
        report = _copy(path, files, None, progress)
        if not report.lost_bytes and not report.unnamed:
            return report
    report = _copy(
        path,
        files,
        folder or path.with_name(path.name.removesuffix(".mcap") + "_recovered"),
        progress,
    )
    if report.message_count:
        return report
    raise RecoverError(f"{path} holds no whole message: nothing can be recovered")


def _copy(
    source: Path,
    files: list[_File],
    folder: Path | None,
    progress: Callable[[float], None] | None,
) -> Recovery:
    """Read all files, write their messages into a folder if there is one, and count."""
    custom = {key: text for file in files for key, text in file.custom_data.items()}
    bag = None
    count, first, last = 0, 0, 0
    for file in files:
        for spec, message in file.messages(progress):
            if folder is not None:
                bag = bag or BagWriter(folder, custom, compression=file.compression)
                bag.add_topic(spec)
                bag.write(spec.name, message.log_time, message.publish_time, message.data)
            first = min(first, message.log_time) if count else message.log_time
            last = max(last, message.log_time)
            count += 1
    unnamed = sum(file.unnamed for file in files)
    if unnamed and not count:
        raise RecoverError(
            f"{source}: {unnamed} messages can be read, but what their topics are was in a damaged "
            "part of the file: nothing can be recovered"
        )
    return Recovery(
        source=source,
        folder=bag.close() if bag is not None else None,
        message_count=count,
        damaged_chunks=sum(file.damaged_chunks for file in files),
        lost_bytes=sum(file.lost_bytes for file in files),
        unnamed=unnamed,
        duration=(last - first) * 1e-9,
    )
