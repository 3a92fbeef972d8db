"""Repair what a killed recorder leaves: MCAP files without an index, a bag without ``metadata.yaml``.

An MCAP file is a sequence of records that starts and ends with the same eight bytes; the index at its
end is a convenience that can be rebuilt from the chunks. The repair keeps every byte of every whole
chunk where it is, cuts what was half written behind the last one, and appends the index, so it needs
almost no space and takes one read of the file. Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import yaml
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import breakup_chunk

from der_planner.recording.layout import (
    METADATA_FILE,
    RUN_KEY,
    BagSummary,
    FileSummary,
    OfferedQos,
    TopicSpec,
)

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
        chunk = scan.chunks[-1]
        if offset >= chunk.chunk_start_offset + chunk.chunk_length:
            chunk.message_index_offsets[index.channel_id] = offset
            chunk.message_index_length += length


def _take_chunk(scan: FileScan, offset: int, length: int, chunk: Chunk) -> None:
    try:
        records = breakup_chunk(chunk, validate_crc=True)
    except Exception:  # whatever a decompressor makes of damaged bytes
        scan.damaged_chunks += 1
        return
    for record in records:
        if isinstance(record, Schema):
            scan.schemas[record.id] = record
        elif isinstance(record, Channel):
            scan.channels[record.id] = record
        elif isinstance(record, Message):
            scan.count_message(record)
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


def finish_file(path: Path, progress: Callable[[float], None] | None = None) -> FileScan:
    """Cut the half-written end of a file and append its index; a finished file stays as it is.

    Args:
        path: an MCAP file.
        progress: called with the fraction read.

    Returns:
        What was found, before the repair.

    Raises:
        RecoverError: it is no MCAP file.
        OSError: it cannot be read or written.
    """
    scan = scan_file(path, progress)
    if scan.complete:
        return scan
    ending = _ending(scan)
    with path.open("r+b") as file:
        file.truncate(scan.data_end)
        file.seek(scan.data_end)
        file.write(ending)
        file.flush()
        os.fsync(file.fileno())
    return scan


def copy_finished(path: Path, copy: Path) -> Path:
    """Copy the whole records of an unfinished file and its new index; the original stays as it is.

    Raises:
        RecoverError: it holds no whole message.
        OSError: no space for the copy.
    """
    scan = scan_file(path)
    if not scan.message_count:
        raise RecoverError(f"{path} holds no whole message")
    shutil.copyfile(path, copy)
    with copy.open("r+b") as file:
        file.truncate(scan.data_end)
        file.seek(scan.data_end)
        file.write(_ending(scan))
    return copy


def _ending(scan: FileScan) -> bytes:
    """Return the end of the data section, the summary and the footer."""
    data_end = RecordBuilder()
    DataEnd(0).write(data_end)
    closing = data_end.end()
    start = scan.data_end + len(closing)
    summary = RecordBuilder()
    offsets: list[SummaryOffset] = []
    groups: list[tuple[Opcode, list[Any]]] = [
        (Opcode.SCHEMA, list(scan.schemas.values())),
        (Opcode.CHANNEL, list(scan.channels.values())),
        (Opcode.STATISTICS, [_statistics(scan)]),
        (Opcode.CHUNK_INDEX, scan.chunks),
        (Opcode.METADATA_INDEX, [index for index, _ in scan.metadata]),
    ]
    for opcode, records in groups:
        begin = summary.count
        for record in records:
            record.write(summary)
        if records:
            offsets.append(SummaryOffset(opcode, start + begin, summary.count - begin))
    offset_start = start + summary.count
    for offset in offsets:
        offset.write(summary)
    body = summary.end()
    head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start)
    checksum = zlib.crc32(head, zlib.crc32(body))
    footer = RecordBuilder()
    Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=checksum).write(
        footer
    )
    return closing + body + footer.end() + MAGIC


def _statistics(scan: FileScan) -> Statistics:
    return Statistics(
        attachment_count=0,
        channel_count=len(scan.channels),
        channel_message_counts=dict(scan.channel_counts),
        chunk_count=len(scan.chunks),
        message_count=scan.message_count,
        message_end_time=scan.last,
        message_start_time=scan.first,
        metadata_count=len(scan.metadata),
        schema_count=len(scan.schemas),
    )


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


@dataclass(frozen=True)
class Recovery:
    """What a repair found and did.

    Attributes:
        path: of the bag.
        repaired: files that got their index back.
        message_count: in the whole bag now.
        lost_bytes: cut from the ends of files.
        damaged_chunks: chunks that could not be read; they stay in the file, out of its index.
        wrote_metadata: ``metadata.yaml`` was missing or out of date.
        duration: from the first to the last message [s].
    """

    path: Path
    repaired: tuple[str, ...]
    message_count: int
    lost_bytes: int
    damaged_chunks: int
    wrote_metadata: bool
    duration: float


def recover_bag(path: Path, progress: Callable[[float], None] | None = None) -> Recovery:
    """Repair a bag folder, or one MCAP file, in place.

    Args:
        path: folder of the bag or an MCAP file.
        progress: called with the fraction of the present file.

    Raises:
        RecoverError: there is nothing to repair in it: no MCAP file, no whole message.
        OSError: it cannot be read or written.
    """
    path = Path(path)
    files = bag_files(path)
    scans = [finish_file(file, progress) for file in files]
    if not any(scan.message_count for scan in scans):
        raise RecoverError(f"{path} holds no whole message: nothing can be recovered")
    repaired = tuple(scan.path.name for scan in scans if not scan.complete)
    wrote = path.is_dir() and (bool(repaired) or not (path / METADATA_FILE).exists())
    if wrote:
        _summary(scans).write(path)
    first = min(scan.first for scan in scans if scan.message_count)
    return Recovery(
        path=path,
        repaired=repaired,
        message_count=sum(scan.message_count for scan in scans),
        lost_bytes=sum(scan.lost_bytes for scan in scans),
        damaged_chunks=sum(scan.damaged_chunks for scan in scans),
        wrote_metadata=wrote,
        duration=(max(scan.last for scan in scans) - first) * 1e-9,
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


def _summary(scans: list[FileScan]) -> BagSummary:
    topics: dict[str, TopicSpec] = {}
    counts: dict[str, int] = {}
    custom: dict[str, str] = {}
    for scan in scans:
        for spec in scan.topics():
            topics.setdefault(spec.name, spec)
        for topic, count in scan.counts.items():
            counts[topic] = counts.get(topic, 0) + count
        custom.update(scan.run_data())
    files = [
        FileSummary(scan.path.name, scan.message_count, scan.first, scan.last) for scan in scans
    ]
    return BagSummary(files, list(topics.values()), counts, custom)


def parse_run(custom_data: dict[str, str]) -> dict[str, Any]:
    """Return the run's description (the recorder's parameter ``metadata``), empty if there is none."""
    try:
        value = json.loads(custom_data.get(RUN_KEY, "") or "{}")
    except json.JSONDecodeError:
        return {}
    return value if isinstance(value, dict) else {}
