"""One recording from start to stop: a queue before the disk and a thread that empties it.

Messages arrive on the node's thread; the disk is touched only here, so a slow disk delays no
subscription. The queue is bounded in bytes: what does not fit is counted, never silently lost.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from der_planner.bags.topics import TopicSpec
from der_planner.bags.writer import BagWriteError, BagWriter

QUEUE_BYTES = 256 << 20
FLUSH_INTERVAL = 1.0


@dataclass(frozen=True)
class SessionStatus:
    """What a recording says of itself.

    Attributes:
        folder: of the bag.
        messages: written.
        bytes: in the bag's files.
        files: of the bag.
        dropped: messages that did not fit the queue.
        queued_bytes: waiting for the disk.
        paused: messages are ignored.
        failure: why the recording stopped by itself; empty while all is well.
    """

    folder: Path
    messages: int
    bytes: int
    files: int
    dropped: int
    queued_bytes: int
    paused: bool
    failure: str


class RecordingSession:
    """Writes messages into a `BagWriter` on a thread of its own, and flushes it every second.

    Args:
        writer: of the bag, just opened.
        flush_interval: between flushes [s]; a killed process loses what came after the last one.
        queue_bytes: bound of what waits for the disk.
        on_failure: called with the reason, on the session's thread, when the recording stops by
            itself.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        writer: BagWriter,
        *,
        flush_interval: float = FLUSH_INTERVAL,
        queue_bytes: int = QUEUE_BYTES,
        on_failure: Callable[[str], None] = lambda _: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._writer = writer
        self._flush_interval = flush_interval
        self._limit = queue_bytes
        self._on_failure = on_failure
        self._clock = clock
        self._queue: queue.SimpleQueue[tuple[TopicSpec, int, int, bytes] | None]
        self._queue = queue.SimpleQueue()
        self._queued = 0
        self._count_lock = threading.Lock()
        self._dropped = 0
        self._failure = ""
        self.paused = False
        self._thread = threading.Thread(target=self._run, name="bag writer", daemon=True)
        self._thread.start()

    @property
    def folder(self) -> Path:
        """The bag that is written."""
        return self._writer.folder

    def put(self, spec: TopicSpec, log_time: int, publish_time: int, data: bytes) -> bool:
        """Queue one message; False if it was not taken (paused, failed or no room).

        Args:
            spec: its topic.
            log_time: when it arrived [ns].
            publish_time: when it was sent [ns].
            data: serialized CDR.
        """
        if self.paused or self._failure:
            return False
        with self._count_lock:
            if self._queued + len(data) > self._limit:
                self._dropped += 1
                return False
            self._queued += len(data)
        self._queue.put((spec, log_time, publish_time, data))
        return True

    def status(self) -> SessionStatus:
        """Return counters and the reason of a failure."""
        return SessionStatus(
            folder=self._writer.folder,
            messages=self._writer.message_count,
            bytes=self._writer.byte_count,
            files=self._writer.file_count,
            dropped=self._dropped,
            queued_bytes=self._queued,
            paused=self.paused,
            failure=self._failure,
        )

    def stop(self) -> SessionStatus:
        """Write what is queued, close the bag, and return the last status; may be called twice."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()
        return self.status()

    def _run(self) -> None:
        try:
            self._drain()
            self._writer.close()
        except BagWriteError as error:
            self._failure = str(error)
        except Exception as error:  # a bug must not look like a good recording
            self._failure = f"the bag writer failed: {error!r}"
        if self._failure:
            self._on_failure(self._failure)

    def _drain(self) -> None:
        due = self._clock() + self._flush_interval
        while True:
            try:
                item = self._queue.get(timeout=max(0.0, due - self._clock()))
                if item is None:
                    return
                self._write(*item)
            except queue.Empty:
                pass
            if self._clock() >= due:
                self._writer.flush()
                due = self._clock() + self._flush_interval

    def _write(self, spec: TopicSpec, log_time: int, publish_time: int, data: bytes) -> None:
        with self._count_lock:
            self._queued -= len(data)
        self._writer.add_topic(spec)
        self._writer.write(spec.name, log_time, publish_time, data)
