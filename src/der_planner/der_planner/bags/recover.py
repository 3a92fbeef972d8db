"""Repair what a killed recorder leaves: files without an index, a bag without ``metadata.yaml``.

An MCAP file is a sequence of records that starts and ends with the same eight bytes; the index at
its end is a convenience that can be rebuilt from the chunks. The repair keeps every byte of every
whole chunk where it is, cuts what was half written behind the last one, and appends the index, so
it needs almost no space and takes one read of the file. Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import os
import shutil
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import DataEnd, Footer, MessageIndex, Statistics, SummaryOffset

from der_planner.bags.layout import METADATA_FILE, BagSummary, FileSummary, TopicSpec
from der_planner.bags.scan import MAGIC, FileScan, RecoverError, bag_files, scan_file


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
    tail = RecordBuilder()
    _complete_message_index(scan, tail)
    DataEnd(0).write(tail)
    closing = tail.end()
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
    return bytes(closing + body + footer.end() + MAGIC)


def _complete_message_index(scan: FileScan, tail: RecordBuilder) -> None:
    """Add the message indexes that the last chunk lacks: readers skip channels without one."""
    if not scan.chunks:
        return
    chunk = scan.chunks[-1]
    begin = tail.count
    for number, entries in scan.last_messages.items():
        if number not in chunk.message_index_offsets:
            chunk.message_index_offsets[number] = scan.data_end + tail.count
            MessageIndex(number, entries).write(tail)
    chunk.message_index_length += tail.count - begin


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
