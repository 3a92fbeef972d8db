"""Read an MCAP file record by record, as far as it is whole. Format: https://mcap.dev/spec."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import yaml
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
)
from mcap.stream_reader import get_chunk_data_stream

from der_planner.bags.layout import RUN_KEY, OfferedQos, TopicSpec

MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")


class RecoverError(ValueError):
    """A file is no bag or holds nothing that can be saved."""


@dataclass
class FileScan:
    """What whole records a file holds.

    Attributes:
        path: of the file.
        complete: it has its index and both magic numbers; nothing to repair.
        data_end: byte behind the last whole record of the data section.
        lost_bytes: behind that, to be cut.
        schemas, channels, chunks, metadata: records of these kinds.
        channel_counts: messages by channel number.
        first, last: log times [ns].
        last_messages: log time and place of every message in the last chunk, by channel number.
        damaged_chunks: chunks whose checksum or content is wrong; left out of the index.
    """

    path: Path
    complete: bool = False
    data_end: int = 0
    lost_bytes: int = 0
    damaged_chunks: int = 0
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    metadata: list[tuple[MetadataIndex, Metadata]] = field(default_factory=list)
    channel_counts: dict[int, int] = field(default_factory=dict)
    first: int = 0
    last: int = 0
    last_messages: dict[int, list[tuple[int, int]]] = field(default_factory=dict)

    @property
    def message_count(self) -> int:
        """Messages in whole, undamaged chunks."""
        return sum(self.channel_counts.values())

    @property
    def counts(self) -> dict[str, int]:
        """Messages by topic."""
        return {
            channel.topic: self.channel_counts.get(number, 0)
            for number, channel in self.channels.items()
        }

    @property
    def log_times(self) -> tuple[int, int]:
        """Log times of the first and last message [ns]."""
        return self.first, self.last

    def run_data(self) -> dict[str, str]:
        """Return the strings that the recorder stored at the start of the file."""
        found = (record.metadata for _, record in self.metadata if record.name == RUN_KEY)
        return dict(next(found, {}))

    def topics(self) -> list[TopicSpec]:
        """Return the topics as `TopicSpec`."""
        return [_topic_spec(channel, self.schemas) for channel in self.channels.values()]

    def count_message(self, message: Message) -> None:
        """Take one message into the statistics."""
        self.first = (
            message.log_time if not self.message_count else min(self.first, message.log_time)
        )
        self.last = max(self.last, message.log_time)
        self.channel_counts[message.channel_id] = self.channel_counts.get(message.channel_id, 0) + 1


def scan_file(path: Path, progress: Callable[[float], None] | None = None) -> FileScan:
    """Read a file record by record up to the first that is not whole.

    Args:
        path: an MCAP file, finished or not.
        progress: called with the fraction read.

    Raises:
        RecoverError: it does not begin as an MCAP file.
        OSError: it cannot be read.
    """
    scan = FileScan(path)
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise RecoverError(f"{path} is no MCAP file: it does not begin with the magic number")
        scan.data_end = file.tell()
        while (record := _next_record(file, size)) is not None:
            opcode, offset, payload = record
            if opcode == Opcode.DATA_END:
                scan.complete = _ends_well(file, size)
                break
            _take(scan, opcode, offset, payload)
            scan.data_end = file.tell()
            if progress is not None:
                progress(scan.data_end / size)
    scan.lost_bytes = 0 if scan.complete else size - scan.data_end
    return scan


def _next_record(file: BinaryIO, size: int) -> tuple[int, int, bytes] | None:
    offset = file.tell()
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    opcode, length = _HEAD.unpack(head)
    if opcode == 0 or opcode > max(Opcode) or offset + _HEAD.size + length > size:
        return None
    return opcode, offset, file.read(length)


def _ends_well(file: BinaryIO, size: int) -> bool:
    """Tell whether the last bytes are a footer and the magic number."""
    footer_length = 20
    tail = _HEAD.size + footer_length + len(MAGIC)
    file.seek(max(0, size - tail))
    data = file.read()
    return data[:9] == _HEAD.pack(Opcode.FOOTER, footer_length) and data[-8:] == MAGIC


def _take(scan: FileScan, opcode: int, offset: int, payload: bytes) -> None:
    stream = ReadDataStream(BytesIO(payload))
    length = _HEAD.size + len(payload)
    if opcode == Opcode.SCHEMA:
        schema = Schema.read(stream)
        scan.schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        channel = Channel.read(stream)
        scan.channels[channel.id] = channel
    elif opcode == Opcode.METADATA:
        metadata = Metadata.read(stream)
        scan.metadata.append((MetadataIndex(offset, length, metadata.name), metadata))
    elif opcode == Opcode.MESSAGE:
        scan.count_message(Message.read(stream, len(payload)))
    elif opcode == Opcode.CHUNK:
        _take_chunk(scan, offset, length, Chunk.read(stream))
    elif opcode == Opcode.MESSAGE_INDEX and scan.chunks:
        index = MessageIndex.read(stream)
        if index.channel_id in scan.last_messages:  # not of a damaged chunk
            scan.chunks[-1].message_index_offsets[index.channel_id] = offset
            scan.chunks[-1].message_index_length += length


def _take_chunk(scan: FileScan, offset: int, length: int, chunk: Chunk) -> None:
    try:
        schemas, channels, messages = _open_chunk(chunk)
    except Exception:  # whatever a decompressor or parser makes of damaged bytes
        scan.damaged_chunks += 1
        scan.last_messages = {}
        return
    scan.schemas.update(schemas)
    scan.channels.update(channels)
    scan.last_messages = {}
    for place, message in messages:
        scan.count_message(message)
        entries = scan.last_messages.setdefault(message.channel_id, [])
        entries.append((message.log_time, place))
    scan.chunks.append(
        ChunkIndex(
            chunk_length=length,
            chunk_start_offset=offset,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=chunk.message_end_time,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=chunk.message_start_time,
            uncompressed_size=chunk.uncompressed_size,
        )
    )


def _open_chunk(
    chunk: Chunk,
) -> tuple[dict[int, Schema], dict[int, Channel], list[tuple[int, Message]]]:
    """Return schemas and channels by number, and each message with its place in the chunk."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    messages: list[tuple[int, Message]] = []
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    while stream.count < size:
        place = stream.count
        opcode, length = stream.read1(), stream.read8()
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            channels[channel.id] = channel
        elif opcode == Opcode.MESSAGE:
            messages.append((place, Message.read(stream, length)))
        else:
            stream.read(length)
    return schemas, channels, messages


def _topic_spec(channel: Channel, schemas: dict[int, Schema]) -> TopicSpec:
    schema = schemas[channel.schema_id]
    profiles = yaml.safe_load(channel.metadata.get("offered_qos_profiles", "") or "[]")
    qos = tuple(
        OfferedQos(
            reliability=str(profile["reliability"]),
            durability=str(profile["durability"]),
            history=str(profile["history"]),
            depth=int(profile["depth"]),
        )
        for profile in profiles
    )
    return TopicSpec(
        name=channel.topic,
        type_name=schema.name,
        definition=schema.data.decode(),
        type_hash=channel.metadata.get("topic_type_hash", ""),
        qos=qos,
        latched=bool(qos) and all(profile.durability == "transient_local" for profile in qos),
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


def parse_run(custom_data: dict[str, str]) -> dict[str, Any]:
    """Return the run's description (the recorder's parameter ``metadata``); empty if none."""
    try:
        value = json.loads(custom_data.get(RUN_KEY, "") or "{}")
    except (json.JSONDecodeError, TypeError):  # no JSON, or no text at all
        return {}
    return value if isinstance(value, dict) else {}
