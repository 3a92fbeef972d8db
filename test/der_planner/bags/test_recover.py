"""What is saved of bags that were cut short or damaged; the bag itself stays as it was."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from bags import SECOND, START, TEXT, read_texts, spec, string
from mcap.reader import make_reader

from der_planner.bags.reader import BagError, BagReader
from der_planner.bags.recover import RecoverError, recover_bag
from der_planner.bags.writer import RUN_KEY, BagWriter

HOLE = 4096
"""Bytes of a damaged block of a disk."""


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_killed_process_loses_only_what_was_not_flushed(tmp_path: Path, compression: str):
    bag = BagWriter(tmp_path / "written", {RUN_KEY: '{"seed": 4}'}, compression=compression)
    for index in range(100):
        stamp = START + index * SECOND // 10
        bag.write(spec("/talk", TEXT), stamp, START, string(f"word {index}"))
        if index % 10 == 9 and index < 90:
            bag.flush()
    # What the operating system has is what a killed process leaves.
    folder = shutil.copytree(tmp_path / "written", tmp_path / "run")
    words = [f"word {index}" for index in range(90)]
    with BagReader(folder) as reader:  # readable before the repair
        assert reader.run() == {"seed": 4}
        assert [message.data for _, _, message in reader.messages()] == words
    found = recover_bag(folder)
    assert found.folder == tmp_path / "run_recovered"
    assert found.message_count == 90
    assert read_texts(found.folder) == words
    with (found.folder / "run_recovered_0.mcap").open("rb") as file:
        messages = list(make_reader(file, validate_crcs=True).iter_messages())
    assert [message.publish_time for _, _, message in messages] == [START] * 90
    with BagReader(found.folder) as reader:
        assert reader.run() == {"seed": 4}
    assert recover_bag(found.folder).folder is None  # it is whole


def write_chunks(folder: Path, count: int, padding: int = 0) -> list[int]:
    """Write chunks of five numbers each; return where each chunk ends."""
    noise = np.random.default_rng(1).integers(65, 90, padding, dtype=np.uint8).tobytes().decode()
    bag = BagWriter(folder, {RUN_KEY: '{"seed": 4}'}, compression="none")
    ends = []
    for index in range(5 * count):
        bag.write(spec("/talk", TEXT), START + index * SECOND, START, string(f"{index} {noise}"))
        if index % 5 == 4:
            bag.flush()
            ends.append(bag.byte_count)
    bag.close()
    return ends


def numbers(path: Path) -> list[int]:
    return [int(text.split()[0]) for text in read_texts(path)]


@pytest.mark.slow
def test_every_cut_keeps_all_whole_chunks(tmp_path: Path):
    ends = write_chunks(tmp_path / "run", 4)
    whole = (tmp_path / "run" / "run_0.mcap").read_bytes()
    for cut in [*range(0, len(whole), 61), *ends, *(end - 1 for end in ends)]:
        file = tmp_path / "cut.mcap"
        file.write_bytes(whole[:cut])
        try:
            found = recover_bag(file, tmp_path / f"saved_{cut}")
        except RecoverError:
            assert cut < ends[0]
            continue
        # A chunk counts as soon as it is whole, even without its message index.
        assert found.message_count >= 5 * sum(end <= cut for end in ends)
        assert numbers(found.folder) == list(range(found.message_count))
        shutil.rmtree(found.folder)


@pytest.mark.slow
@pytest.mark.parametrize("fill", [b"\0", b"\xff", None], ids=["zeros", "ones", "noise"])
@pytest.mark.parametrize("finished", [True, False])
def test_a_hole_takes_the_chunks_that_it_touches_and_no_other(
    tmp_path: Path, fill: bytes | None, finished: bool
):
    ends = write_chunks(tmp_path / "run", 20, padding=1000)
    begins = [0, *ends[:-1]]
    file = tmp_path / "run" / "run_0.mcap"
    whole = file.read_bytes() if finished else file.read_bytes()[: ends[-1]]
    if not finished:
        (tmp_path / "run" / "metadata.yaml").unlink()
    for place in range(0, len(whole) - HOLE, 5003):
        noise = np.random.default_rng(place).integers(0, 256, HOLE, dtype=np.uint8).tobytes()
        broken = whole[:place] + (fill * HOLE if fill else noise) + whole[place + HOLE :]
        file.write_bytes(broken)
        found = recover_bag(tmp_path / "run", tmp_path / f"saved_{place}")
        kept = [
            chunk
            for chunk, (begin, end) in enumerate(zip(begins, ends, strict=True))
            if place >= end or place + HOLE <= begin
        ]
        assert set(numbers(found.folder)) >= {5 * c + k for c in kept for k in range(5)}
        assert found.lost_bytes > 0
        assert file.read_bytes() == broken
        shutil.rmtree(found.folder)


def test_damaged_repetitions_of_a_definition_change_no_topic(tmp_path: Path):
    folder = tmp_path / "run"
    write_chunks(folder, 4)
    first, *others = (folder / "run_0.mcap").read_bytes().split(b"/talk")
    (folder / "run_0.mcap").write_bytes(b"/tulk".join([first + b"/talk" + others[0], *others[1:]]))
    assert numbers(recover_bag(folder, tmp_path / "saved").folder) == list(range(20))
    with BagReader(tmp_path / "saved") as reader:
        assert set(reader.topics) == {"/talk"}


@pytest.mark.parametrize("repeated", [True, False])
def test_topics_are_known_though_the_first_chunk_is_damaged(tmp_path, monkeypatch, repeated):
    if not repeated:  # as in bags of recorders that say it once
        monkeypatch.setattr(BagWriter, "_repeat_definitions", lambda _: None)
    folder = tmp_path / "run"
    ends = write_chunks(folder, 4)
    file = folder / "run_0.mcap"
    data = bytearray(file.read_bytes()[: ends[-1]])  # killed, too: no index that knows topics
    data[data.find(b"0 \0")] ^= 0xFF
    file.write_bytes(data)
    if not repeated:
        with pytest.raises(RecoverError, match="15 messages can be read, but"):
            recover_bag(folder)
        return
    found = recover_bag(folder)
    assert found.lost_bytes > 0
    assert found.unnamed == 0
    assert numbers(found.folder) == list(range(5, 20))
    with BagReader(folder) as reader:  # the damaged bag itself
        assert len(list(reader.raw())) == 15


def test_what_is_no_bag_is_named(tmp_path: Path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.mcap").write_text("hello")
    for path in (tmp_path / "empty", tmp_path / "text.mcap"):
        with pytest.raises(RecoverError, match=path.name):
            recover_bag(path)
        with pytest.raises(BagError, match=path.name):
            BagReader(path)
    with pytest.raises(BagError, match="no bag at"):
        BagReader(tmp_path / "nowhere")
