"""One recording from start to stop: a queue before the disk and a thread that empties it.

Messages arrive on the node's thread; the disk is touched only here, so a slow disk delays no
subscription. The queue is bounded in bytes: what does not fit is counted, never silently lost.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable

from der_planner.bags.topics import TopicSpec
from der_planner.bags.writer import BagWriteError, BagWriter


class RecordingSession:
    """Writes messages into a `BagWriter` on a thread of its own, and flushes it every second.

    Args:
        writer: of the bag, just opened.
        flush_interval: between flushes [s]; a killed process loses what came after the last one.
        queue_bytes: bound of what waits for the disk.
        on_failure: called with the reason, on the session's thread, when the recording stops by
            itself.

    Attributes:
        writer: of the bag; its counters may be read.
        dropped: messages that did not fit the queue.
        queued_bytes: waiting for the disk.
        failure: why the recording stopped by itself; empty while all is well.
    """

    def __init__(
        self,
        writer: BagWriter,
        *,
        flush_interval: float = 1.0,
        queue_bytes: int = 256 << 20,
        on_failure: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.writer = writer
        self._flush_interval = flush_interval
        self._limit = queue_bytes
        self._on_failure = on_failure
        self._queue: queue.SimpleQueue[tuple[TopicSpec, int, int, bytes] | None]
        self._queue = queue.SimpleQueue()
        self.queued_bytes = 0
        self._count_lock = threading.Lock()
        self.dropped = 0
        self.failure = ""
        self._thread = threading.Thread(target=self._run, name="bag writer", daemon=True)
        self._thread.start()

    def put(self, spec: TopicSpec, log_time: int, publish_time: int, data: bytes) -> bool:
        """Queue one message; False if it was not taken (failed or no room).

        Args:
            spec: its topic.
            log_time: when it arrived [ns].
            publish_time: when it was sent [ns].
            data: serialized CDR.
        """
        if self.failure:
            return False
        with self._count_lock:
            if self.queued_bytes + len(data) > self._limit:
                self.dropped += 1
                return False
            self.queued_bytes += len(data)
        self._queue.put((spec, log_time, publish_time, data))
        return True

    def stop(self) -> None:
        """Write what is queued, and close the bag; may be called twice."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()

    def _run(self) -> None:
        try:
            self._drain()
            self.writer.close()
        except BagWriteError as error:
            self.failure = str(error)
        except Exception as error:  # a bug must not look like a good recording
            self.failure = f"the bag writer failed: {error!r}"
        if self.failure:
            self._on_failure(self.failure)

    def _drain(self) -> None:
        due = time.monotonic() + self._flush_interval
        while True:
            try:
                item = self._queue.get(timeout=max(0.0, due - time.monotonic()))
                if item is None:
                    return
                spec, log_time, publish_time, data = item
                with self._count_lock:
                    self.queued_bytes -= len(data)
                self.writer.write(spec, log_time, publish_time, data)
            except queue.Empty:
                pass
            if time.monotonic() >= due:
                self.writer.flush()
                due = time.monotonic() + self._flush_interval
