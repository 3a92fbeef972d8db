"""Save what can be read of bags that a kill, a crash, a full or a damaged disk left.

python3 scripts/recover_bag.py out/bags/same_direction_der_optimal_trial1
python3 scripts/recover_bag.py run.mcap --out saved/run

The bag itself stays as it is: its whole messages go into a new bag, BAG_recovered or that of --out.
For a bag that is whole nothing is written, unless --out names where.
"""

from __future__ import annotations

import argparse
import mmap
import re
import struct
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from der_planner.bags.topics import TopicSpec, parse_qos
from der_planner.bags.writer import METADATA_FILE, RUN_KEY, BagWriter

# An MCAP file is a sequence of records between two magic numbers; messages lie in chunks that carry
# checksums, and the index at the end only helps to find them (https://mcap.dev/spec). Every chunk
# that is whole is read, wherever it lies, and its messages are written again.

MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
"""A record's opcode and length."""
_CHUNK_NUMBERS = 40
"""Bytes of a chunk beside its messages and the name of their compression."""
_CHUNK = re.compile(rb"\x06.{6}\0\0.{28}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd)", re.DOTALL)
"""What a chunk begins with: opcode, length, two times, size, checksum, name of the compression."""


class RecoverError(ValueError):
    """A file is no bag or holds nothing that can be saved."""


@dataclass(frozen=True)
class Recovery:
    """What was found in a bag, and where it was saved.

    Attributes:
        source: the bag, which is as it was.
        folder: the new bag; None where the source is whole and nothing was written.
        message_count: that could be read.
        lost_bytes: in damaged chunks and in what is no record.
        unnamed: messages that could be read, but whose topic nothing in the file tells.
    """

    source: Path
    folder: Path | None
    message_count: int
    lost_bytes: int
    unnamed: int


class _File:
    """One MCAP file that is read as far as it is whole; what is not is counted."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            is_empty = path.stat().st_size == 0
            self._data = b"" if is_empty else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self._is_closed = self._data[-len(MAGIC) :] == MAGIC
        self.lost_bytes = 0
        self.has_index = False
        self.compression = "zstd"
        self.custom_data: dict[str, str] = {}
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        counts: Counter[int] = Counter()
        for record in self._records():
            if isinstance(record, Message):
                counts[record.channel_id] += 1
            # The first definition is inside a chunk, whose checksum tells that it is whole.
            elif isinstance(record, Schema):
                schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                channels.setdefault(record.id, record)
            elif isinstance(record, Metadata) and record.name == RUN_KEY:
                self.custom_data = dict(record.metadata)
            elif isinstance(record, Footer):
                self.has_index = self._is_closed
        self._topics = {
            number: _topic_spec(channel, schemas[channel.schema_id])
            for number, channel in channels.items()
            if channel.schema_id in schemas
        }
        self.message_count = sum(counts[number] for number in self._topics)
        self.unnamed = counts.total() - self.message_count

    def messages(self) -> Iterator[tuple[TopicSpec, Message]]:
        """Yield the messages whose topic is known, in the order of the file."""
        for record in self._records():
            if isinstance(record, Message) and record.channel_id in self._topics:
                yield self._topics[record.channel_id], record

    def _records(self) -> Iterator[McapRecord]:
        """Yield what is whole, in chunks and outside; count the bytes of what is not.

        Where the bytes are no record, the next chunk is looked for.
        """
        self.lost_bytes = 0
        place = len(MAGIC) if self._data[: len(MAGIC)] == MAGIC else 0
        end = len(self._data) - len(MAGIC) * self._is_closed
        while place < end:
            try:
                records, after = self._read(place)
                yield from records
            except Exception:  # whatever a parser or decompressor makes of damaged bytes
                found = _CHUNK.search(self._data, place + 1)
                after = found.start() if found else end
                self.lost_bytes += after - place
            place = after

    def _read(self, place: int) -> tuple[list[McapRecord], int]:
        """Return the records that begin at a byte, several for a chunk, and where they end."""
        opcode, length = _HEAD.unpack_from(self._data, place)
        after = place + _HEAD.size + length
        if not 0 < opcode <= max(Opcode) or after > len(self._data):
            raise RecoverError("no record begins here")
        stream = BytesIO(self._data[place:after])
        record = next(StreamReader(stream, skip_magic=True, emit_chunks=True).records)
        if not isinstance(record, Chunk):
            return [record], after
        if _CHUNK_NUMBERS + len(record.compression) + len(record.data) != length:
            raise RecoverError("the lengths inside do not fit")
        self.compression = record.compression or "none"
        return breakup_chunk(record, validate_crc=True), after


def _topic_spec(channel: Channel, schema: Schema) -> TopicSpec:
    return TopicSpec(
        name=channel.topic,
        type_name=schema.name,
        definition=schema.data.decode(),
        type_hash=channel.metadata.get("topic_type_hash", ""),
        qos=parse_qos(channel.metadata.get("offered_qos_profiles", "")),
        encoding=schema.encoding,
    )


def _bag_files(path: Path) -> list[Path]:
    """Return the MCAP files of a bag in the order of their numbers, which end their names.

    Raises:
        RecoverError: there are none.
    """
    if path.is_file():
        return [path]
    found = sorted(path.glob("*.mcap"), key=lambda file: (len(file.name), file.name))
    if not found:
        raise RecoverError(
            f"{path} holds no MCAP file: no bag, or one of sqlite3 (`ros2 bag reindex {path}`)"
        )
    return found


def recover_bag(path: Path, folder: Path | None = None) -> Recovery:
    """Write every message of a bag that can be read into a new bag.

    Args:
        path: folder of the bag or an MCAP file; it is only read.
        folder: of the new bag; if None, PATH_recovered, and nothing is written for a whole bag.

    Raises:
        RecoverError: there is no MCAP file, or no message whose topic is known.
        BagWriteError: the new bag cannot be written: its folder is there already, or no space.
        OSError: the bag cannot be read.
    """
    path = Path(path)
    files = [_File(file) for file in _bag_files(path)]
    found = Recovery(
        source=path,
        folder=folder,
        message_count=sum(file.message_count for file in files),
        lost_bytes=sum(file.lost_bytes for file in files),
        unnamed=sum(file.unnamed for file in files),
    )
    is_whole = not found.lost_bytes and all(file.has_index for file in files)
    if folder is None and is_whole and (path.is_file() or (path / METADATA_FILE).exists()):
        return found
    if not found.message_count and found.unnamed:
        raise RecoverError(
            f"{path}: {found.unnamed} messages can be read, but what their topics are was in a "
            "damaged part of the file: nothing can be recovered"
        )
    if not found.message_count:
        raise RecoverError(f"{path} holds no whole message: nothing can be recovered")
    folder = folder or path.with_name(path.name.removesuffix(".mcap") + "_recovered")
    custom = {key: text for file in files for key, text in file.custom_data.items()}
    bag = BagWriter(folder, custom, compression=files[0].compression)
    for file in files:
        for spec, message in file.messages():
            bag.write(spec, message.log_time, message.publish_time, message.data)
    return replace(found, folder=bag.close())


def describe(found: Recovery) -> str:
    """Return a sentence on what was found and done."""
    held = f"{found.source}: {found.message_count} messages"
    if found.folder is None:
        return f"{held}, whole, nothing to recover"
    text = f"{held} saved in {found.folder}; lost: {found.lost_bytes} bytes"
    return text + f", {found.unnamed} messages whose topic nothing tells" * bool(found.unnamed)


def main() -> int:
    """Run the command line; 0 when something was saved of every bag, 1 otherwise."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="folder or .mcap file")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="the new bag, for one BAG")
    options = parser.parse_args()
    if options.out is not None and len(options.bags) > 1:
        parser.error("--out names one new bag: give one BAG")
    failed = 0
    for path in options.bags:
        try:
            print(describe(recover_bag(path, options.out)))
        except (RecoverError, OSError) as error:
            print(f"error: {error}", file=sys.stderr)
            failed += 1
    return 1 if failed else 0
