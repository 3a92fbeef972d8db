"""Bags on disk, read back by rosbags and by mcap's own reader."""

import errno
import os
import resource
from pathlib import Path

import pytest
import yaml
from bags import SECOND, START, TEXT, read_texts, spec, string
from mcap.reader import make_reader

from der_planner.bags.reader import BagReader
from der_planner.bags.writer import METADATA_FILE, RUN_KEY, BagWriteError, BagWriter

TALK = spec("/talk", TEXT)


def fill(bag: BagWriter, count: int, step: int = SECOND // 10, first: int = 0) -> None:
    for index in range(first, first + count):
        bag.write(TALK, START + index * step, START + index * step - 5, string(f"word {index}"))
        if index % 30 == 29:
            bag.flush()


def test_rosbags_and_mcap_read_what_was_written(tmp_path: Path):
    bag = BagWriter(tmp_path / "run", {RUN_KEY: '{"motion": "circle"}'})
    fill(bag, 11)
    bag.write(spec("/plan", TEXT, latched=True), START + 3 * SECOND, START, string("plan"))
    assert bag.close() == tmp_path / "run"
    words = [*(f"word {index}" for index in range(11)), "plan"]
    assert read_texts(tmp_path / "run") == words
    with (tmp_path / "run" / "run_0.mcap").open("rb") as file:
        found = list(make_reader(file, validate_crcs=True).iter_messages())
    assert [message.data for _, _, message in found] == [string(word) for word in words]
    schema, channel, message = found[0]
    assert message.publish_time == START - 5
    assert (schema.name, schema.encoding, channel.message_encoding) == (TEXT, "ros2msg", "cdr")
    assert set(channel.metadata) == {"offered_qos_profiles", "topic_type_hash"}
    with BagReader(tmp_path / "run") as reader:
        assert reader.run() == {"motion": "circle"}
    document = yaml.safe_load((tmp_path / "run" / METADATA_FILE).read_text())
    info = document["rosbag2_bagfile_information"]
    assert (info["version"], info["storage_identifier"]) == (9, "mcap")
    assert info["relative_file_paths"] == ["run_0.mcap"]
    assert info["message_count"] == 12
    assert info["starting_time"]["nanoseconds_since_epoch"] == START
    assert info["duration"]["nanoseconds"] == 3 * SECOND
    first, second = info["topics_with_message_count"]
    counts = {each["topic_metadata"]["name"]: each["message_count"] for each in (first, second)}
    assert counts == {"/talk": 11, "/plan": 1}
    (profile,) = second["topic_metadata"]["offered_qos_profiles"]
    assert profile["durability"] == "transient_local"


def test_bytes_behind_the_content_are_no_damage_but_missing_ones_are(tmp_path: Path):
    """As rclpy's serialize_message leaves them after empty sequences of doubles."""
    bag = BagWriter(tmp_path / "run")
    bag.write(TALK, START, START, string("whole") + bytes(8))
    bag.write(TALK, START + 1, START, string("cut short")[:-4])
    with BagReader(bag.close()) as reader:
        messages = reader.messages()
        assert next(messages)[2].data == "whole"
        with pytest.raises(Exception, match=r"String|string|Truncated|size"):
            next(messages)


def test_small_messages_do_not_share_chunks_with_large_ones(tmp_path: Path):
    bag = BagWriter(tmp_path / "run", compression="none")
    for index in range(60):
        when = START + index * SECOND // 30
        bag.write(TALK, when, when, string(f"word {index}"))
        bag.write(spec("/image", TEXT), when + 5, when, string("x" * 200_000))
        if index % 30 == 29:
            bag.flush()
    bag.close()
    with (tmp_path / "run" / "run_0.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    topics = {number: channel.topic for number, channel in summary.channels.items()}
    held = [{topics[n] for n in index.message_index_offsets} for index in summary.chunk_indexes]
    assert held.count({"/image"}) == 60
    assert held.count({"/talk"}) == 2
    assert len(held) == 62
    everything = [text[:4] for text in read_texts(tmp_path / "run")]
    assert everything == ["word", "xxxx"] * 60  # still in the order of time


def test_a_folder_with_content_is_refused(tmp_path: Path):
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(BagWriteError, match="not empty"):
        BagWriter(tmp_path)
    assert (tmp_path / "mine.txt").read_text() == "precious"


def test_a_file_that_cannot_grow_is_reported_and_readable(tmp_path: Path):
    """The kernel's file size limit refuses a write in its middle, as a full disk does."""
    folder = tmp_path / "run"
    bag = BagWriter(folder, compression="none")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, before[1]))
    try:
        with pytest.raises(BagWriteError, match=f"recover_bag.py {folder} saves what") as refused:
            fill(bag, 10_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert os.strerror(errno.EFBIG) in str(refused.value)
    with BagReader(folder) as reader:
        texts = [message.data for _, _, message in reader.messages()]
    assert len(texts) > 200
    assert texts == [f"word {i}" for i in range(len(texts))]
