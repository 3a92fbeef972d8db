"""The queue and thread between the node and the disk."""

import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
from bags import START, TEXT, read_texts, spec, string
from waiting import wait_for

from der_planner.bags import writer
from der_planner.bags.reader import BagReader
from der_planner.bags.session import RecordingSession
from der_planner.bags.writer import METADATA_FILE, BagWriteError, BagWriter

TALK = "/talk"


def test_flush_without_new_messages_makes_the_file_readable(tmp_path: Path):
    session = RecordingSession(BagWriter(tmp_path / "run"), flush_interval=0.02)
    session.put(spec(TALK, TEXT), START, START, string("early"))
    seen: list[str] = []

    def on_disk() -> bool:
        try:
            with BagReader(tmp_path / "run") as bag:
                seen[:] = [message.data for _, _, message in bag.messages()]
        except ValueError:
            return False
        return seen == ["early"]

    wait_for(on_disk, "the message on the disk")
    session.stop()


def test_full_queue_drops_and_counts(tmp_path: Path):
    release = threading.Event()

    class SlowBag(BagWriter):
        def write(self, *arguments):
            release.wait(20.0)
            super().write(*arguments)

    session = RecordingSession(SlowBag(tmp_path / "run"), queue_bytes=10_000)
    topic = spec(TALK, TEXT)
    taken = sum(session.put(topic, START + i, START, string("x" * 1_000)) for i in range(50))
    assert 5 < taken < 15
    assert session.dropped == 50 - taken
    release.set()
    session.stop()
    assert len(read_texts(tmp_path / "run")) == taken


def test_little_space_stops_with_a_whole_bag_and_says_so_at_once(tmp_path: Path, monkeypatch):
    free = [1 << 30]
    monkeypatch.setattr(writer.shutil, "disk_usage", lambda _: SimpleNamespace(free=free[0]))
    told: list[str] = []
    session = RecordingSession(
        BagWriter(tmp_path / "run", minimum_free=1 << 20),
        flush_interval=0.02,
        on_failure=told.append,
    )
    topic = spec(TALK, TEXT)
    session.put(topic, START, START, string("kept"))
    wait_for(lambda: session.writer.message_count == 1, "the message")
    free[0] = 1000
    wait_for(lambda: told, "the failure")
    assert "fewer than 1 MiB are free" in told[0]
    assert session.failure == told[0]
    assert not session.put(topic, START + 1, START, string("too late"))
    session.stop()
    assert read_texts(tmp_path / "run") == ["kept"]
    assert (tmp_path / "run" / METADATA_FILE).exists()
    with pytest.raises(BagWriteError, match="fewer than 1 MiB are free"):
        BagWriter(tmp_path / "next", minimum_free=1 << 20)
