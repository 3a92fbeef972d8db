"""Write a bag: raw CDR in MCAP files with embedded definitions, safe at every flush.

rosbag2's own writer keeps a chunk open until it is full; here every `flush` ends the chunk and
hands it to the operating system, so a killed process leaves whole chunks and `recover` only has to
add the index. After a write that fails (full disk) the file is cut behind its last whole chunk and
finished there; after its folder is removed it is written again.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from mcap.writer import CompressionType, Writer

from der_planner.bags.layout import (
    RUN_KEY,
    BagSummary,
    FileSummary,
    TopicSpec,
    file_name,
)
from der_planner.bags.recover import finish_file
from der_planner.bags.scan import scan_file

COMPRESSIONS = {
    "none": CompressionType.NONE,
    "lz4": CompressionType.LZ4,
    "zstd": CompressionType.ZSTD,
}
CHUNK_SIZE = 1 << 20
LARGE = 1 << 17
"""Messages of so many bytes get a chunk of their own, so that whoever reads only the small ones
does not have to read the images between them."""
PROFILE = "ros2"
LIBRARY = "der_planner recorder"


class BagWriteError(OSError):
    """The bag cannot be written any further; the message says why and what is left of it."""


class _Sink:
    """An unbuffered file, so that a failed write is seen by the call that caused it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file: BinaryIO = path.open("x+b", buffering=0)
        self.position = 0

    def write(self, data: bytes | bytearray | memoryview) -> int:
        view = memoryview(data)
        while view:
            written = os.write(self.file.fileno(), view)
            self.position += written
            view = view[written:]
        return len(data)

    def tell(self) -> int:
        return self.position

    def flush(self) -> None:
        """Nothing waits here: every write went to the operating system."""

    def is_still_there(self) -> bool:
        """Tell whether the path still leads to the open file."""
        try:
            named, opened = os.stat(self.path), os.fstat(self.file.fileno())
        except OSError:
            return False
        return (named.st_dev, named.st_ino) == (opened.st_dev, opened.st_ino)

    def save_again(self) -> None:
        """Copy the content of a removed file to its path, whose folder is made again."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("wb") as copy:
            offset = 0
            while block := os.pread(self.file.fileno(), 1 << 20, offset):
                copy.write(block)
                offset += len(block)


class BagWriter:
    """A bag folder that is being written.

    Args:
        folder: the bag; made here, must not exist yet or be empty.
        custom_data: strings kept in the bag and in ``metadata.yaml``.
        compression: of chunks: ``none``, ``lz4`` or ``zstd``.
        split_bytes: begin a new file after this many bytes; 0 = never.
        split_seconds: begin a new file after this recorded time [s]; 0 = never.
        chunk_size: largest chunk [bytes] before compression.

    Raises:
        BagWriteError: the folder exists with something in it or cannot be made.
    """

    def __init__(
        self,
        folder: Path,
        custom_data: Mapping[str, str] | None = None,
        *,
        compression: str = "zstd",
        split_bytes: int = 0,
        split_seconds: float = 0.0,
        chunk_size: int = CHUNK_SIZE,
    ) -> None:
        self.folder = Path(folder)
        self.custom_data = dict(custom_data or {})
        self._compression = COMPRESSIONS[compression]
        self._split_bytes = split_bytes
        self._split_time = round(split_seconds * 1e9)
        self._chunk_size = chunk_size
        self._topics: dict[str, TopicSpec] = {}
        self._counts: dict[str, int] = {}
        self._latched: dict[str, tuple[int, bytes]] = {}
        self._files: list[FileSummary] = []
        self._sink: _Sink | None = None
        self._safe_end = 0
        self._small: list[tuple[TopicSpec, int, int, bytes]] = []
        self._small_bytes = 0
        self._sequences: dict[str, int] = {}
        self.bytes_finished = 0
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if any(self.folder.iterdir()):
                raise BagWriteError(f"the bag folder {self.folder} is not empty: name another one")
            self._open_file()
        except BagWriteError:
            raise
        except OSError as error:
            raise BagWriteError(f"cannot write a bag into {self.folder}: {error}") from error

    @property
    def topics(self) -> Mapping[str, TopicSpec]:
        """The topics added so far, by name."""
        return self._topics

    @property
    def message_count(self) -> int:
        """Messages written, repeated latched ones included."""
        return sum(self._counts.values())

    @property
    def byte_count(self) -> int:
        """Bytes in all files; what waits for the next flush is not counted."""
        return self.bytes_finished + (self._sink.tell() if self._sink else 0)

    @property
    def file_count(self) -> int:
        """Number of files of the bag."""
        return len(self._files)

    def add_topic(self, spec: TopicSpec) -> None:
        """Announce a topic; a second announcement of the same name changes nothing."""
        if spec.name not in self._topics:
            self._topics[spec.name] = spec
            self._counts[spec.name] = 0

    def write(self, topic: str, log_time: int, publish_time: int, data: bytes) -> None:
        """Append one message.

        Args:
            topic: added before.
            log_time: when it arrived [ns].
            publish_time: when it was sent [ns].
            data: serialized CDR with its four-byte header.

        Raises:
            BagWriteError: the storage refused; the bag is finished with what it already held.
        """
        spec = self._topics[topic]
        if spec.latched:
            self._latched[topic] = (publish_time, data)
        if self._is_full(log_time):
            self.split(log_time)
            if spec.latched:
                return  # just written as the repeated message of the new file
        with self._guarded():
            self._append(spec, log_time, publish_time, data)

    def flush(self) -> None:
        """End the chunk and hand everything to the operating system.

        Raises:
            BagWriteError: as `write`, or the bag's folder was removed meanwhile; in that case it is
                made again with everything recorded so far.
        """
        if self._sink is None:
            return
        with self._guarded():
            self._emit_small()
            self._safe_end = self._sink.tell()
        if not self._sink.is_still_there():
            self._save_vanished()

    def split(self, log_time: int) -> None:
        """Finish the present file and begin the next with the latched messages."""
        with self._guarded():
            self._finish_file()
            self._open_file()
            for topic, (publish_time, data) in self._latched.items():
                self._append(self._topics[topic], log_time, publish_time, data)

    def close(self) -> Path:
        """Finish the bag and return its folder; may be called twice.

        Raises:
            BagWriteError: the index could not be written; `recover` can add it later.
        """
        if self._sink is not None:
            if not self._sink.is_still_there():
                self._save_vanished()
            with self._guarded():
                self._finish_file()
                self._write_metadata()
        return self.folder

    def _is_full(self, log_time: int) -> bool:
        present = self._files[-1]
        if self._sink is None or present.message_count == 0:
            return False
        by_size = 0 < self._split_bytes <= self._sink.tell()
        by_time = 0 < self._split_time <= log_time - present.first
        return by_size or by_time

    def _open_file(self) -> None:
        name = file_name(self.folder, len(self._files))
        self._sink = _Sink(self.folder / name)
        self._writer = Writer(
            self._sink,  # has the three methods that the writer calls
            chunk_size=self._chunk_size,
            compression=self._compression,
        )
        self._files.append(FileSummary(name))
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._writer.start(profile=PROFILE, library=LIBRARY)
        if self.custom_data:
            self._writer.add_metadata(RUN_KEY, self.custom_data)
        self._safe_end = self._sink.tell()

    def _append(self, spec: TopicSpec, log_time: int, publish_time: int, data: bytes) -> None:
        self._files[-1].add(log_time)
        self._counts[spec.name] += 1
        if len(data) >= LARGE:
            self._emit(spec, log_time, publish_time, data)
            self._writer.flush()
            return
        self._small.append((spec, log_time, publish_time, data))
        self._small_bytes += len(data)
        if self._small_bytes >= self._chunk_size:
            self._emit_small()

    def _emit_small(self) -> None:
        """Write the small messages that wait, as one chunk."""
        for message in self._small:
            self._emit(*message)
        self._small.clear()
        self._small_bytes = 0
        self._writer.flush()

    def _emit(self, spec: TopicSpec, log_time: int, publish_time: int, data: bytes) -> None:
        if spec.name not in self._channels:
            self._register(spec)
        sequence = self._sequences.get(spec.name, 0)
        self._sequences[spec.name] = sequence + 1
        self._writer.add_message(
            channel_id=self._channels[spec.name],
            log_time=log_time,
            publish_time=publish_time,
            sequence=sequence & 0xFFFFFFFF,
            data=data,
        )

    def _register(self, spec: TopicSpec) -> None:
        if spec.type_name not in self._schemas:
            self._schemas[spec.type_name] = self._writer.register_schema(
                name=spec.type_name, encoding="ros2msg", data=spec.definition.encode()
            )
        self._channels[spec.name] = self._writer.register_channel(
            topic=spec.name,
            message_encoding="cdr",
            schema_id=self._schemas[spec.type_name],
            metadata={
                "offered_qos_profiles": spec.qos_yaml(),
                "topic_type_hash": spec.type_hash,
            },
        )

    def _finish_file(self) -> None:
        assert self._sink is not None
        self._emit_small()
        self._writer.finish()
        self.bytes_finished += self._sink.tell()
        self._sink.file.close()
        self._sink = None

    def _write_metadata(self) -> None:
        BagSummary(self._files, list(self._topics.values()), self._counts, self.custom_data).write(
            self.folder
        )

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        """Turn a refused write into a finished bag and a BagWriteError."""
        try:
            yield
        except OSError as error:
            raise BagWriteError(
                f"recording into {self.folder} stopped: {error}. {self._salvage()}"
            ) from error

    def _salvage(self) -> str:
        """Cut off what was half written, finish the file there, and say how that went."""
        sink, self._sink = self._sink, None
        try:
            try:
                self._finish_cut(sink)
            except OSError:
                # No room even for the index: give back the chunks since the last flush.
                if sink is None:
                    raise
                os.truncate(sink.path, self._safe_end)
                self._finish_cut(sink)
        except OSError as error:
            return (
                f"Its index could not be written either ({error}): free some space, then "
                f"scripts/recover_bag.py {self.folder} repairs it"
            )
        finally:
            if sink is not None:
                sink.file.close()
        return "Every whole chunk is in the bag, which is closed and readable"

    def _finish_cut(self, sink: _Sink | None) -> None:
        if sink is not None:
            finish_file(sink.path)
            found = scan_file(sink.path)
            self.bytes_finished += sink.path.stat().st_size
            self._recount(sink.path.name, found.log_times, found.counts)
        self._write_metadata()

    def _recount(self, name: str, times: tuple[int, int], counts: Mapping[str, int]) -> None:
        """Take over what the last file really holds after it was cut."""
        lost_file = self._files[-1]
        assert lost_file.name == name
        self._files[-1] = FileSummary(name, sum(counts.values()), *times)
        earlier = _counts_of_finished(self.folder, [entry.name for entry in self._files[:-1]])
        self._counts = {
            topic: counts.get(topic, 0) + earlier.get(topic, 0) for topic in self._topics
        }

    def _save_vanished(self) -> None:
        """The folder was removed under the open file: write everything again, then stop."""
        sink, self._sink = self._sink, None
        assert sink is not None
        with contextlib.suppress(OSError):
            self._emit_small()
            self._writer.finish()
        try:
            sink.save_again()
            self._write_metadata()
            left = "What this file of the bag held was saved again in the same place"
        except OSError as error:
            left = f"It could not be made again ({error}): the recording is lost"
        finally:
            sink.file.close()
        raise BagWriteError(f"the bag {self.folder} was removed while it was recorded. {left}")


def _counts_of_finished(folder: Path, names: list[str]) -> dict[str, int]:
    total: dict[str, int] = {}
    for name in names:
        for topic, count in scan_file(folder / name).counts.items():
            total[topic] = total.get(topic, 0) + count
    return total
