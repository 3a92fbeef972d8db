"""Order, times and choice of a replay."""

import itertools
from dataclasses import replace
from pathlib import Path

import pytest
from bags import SECOND, START, TEXT, spec, string

from der_planner.bags.reader import BagError, BagReader
from der_planner.bags.writer import BagWriter
from der_planner.commands.replay_bag import CLOCK_PERIOD, Selection, replay


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Of two files and without metadata, as another recorder that was killed leaves it."""
    for number in range(2):
        writer = BagWriter(tmp_path / f"run_{number}")
        for index in range(10 * number, 10 * number + 10):
            when = START + index * SECOND // 10
            writer.write(spec("/a", TEXT), when, when, string(f"a{index}"))
            writer.write(spec("/b", TEXT), when + 5, when, string(f"b{index}"))
        (writer.close() / f"run_{number}_0.mcap").rename(tmp_path / f"run_{number}.mcap")
    return tmp_path


def play(path: Path, **wanted):
    """Return what is published: times [ns] since the start, topics and bytes."""
    with BagReader(path) as reader:
        return [
            (when - START, topic, message and message.data)
            for when, topic, message in replay(reader, Selection(**wanted))
        ]


def test_messages_come_at_their_times_and_the_clock_runs_between(bag: Path):
    played = play(bag)
    for offset, topic in ((0, "/a"), (5, "/b")):
        assert [(when, data) for when, name, data in played if name == topic] == [
            (index * SECOND // 10 + offset, string(f"{topic[1]}{index}")) for index in range(20)
        ]
    times = [when for when, _, _ in played]
    assert all(0 <= b - a <= CLOCK_PERIOD for a, b in itertools.pairwise(times))


def test_part_choice_and_names(bag: Path):
    played = play(bag, start=0.5, stop=1.0, topics=["/a"], remap={"/a": "/again"})
    assert played[0] == (SECOND // 2, "", None)
    assert [entry[1:] for entry in played if entry[1]] == [
        ("/again", string(f"a{i}")) for i in range(5, 10)
    ]
    assert {topic for _, topic, _ in play(bag, topics=["/b"])} == {"", "/b"}


def test_what_commands_is_played_only_where_it_is_named(tmp_path: Path):
    writer = BagWriter(tmp_path / "run")
    for name in ("/limb/state", "/limb/command", "/lab/arm/pressure_setpoint"):
        writer.write(spec(name, TEXT), START, START, string(name))
    bag = writer.close()
    assert {topic for _, topic, _ in play(bag)} == {"", "/limb/state"}
    named = play(bag, topics=["/limb/command"], remap={"/limb/command": "/old"})
    assert {topic for _, topic, _ in named} == {"", "/old"}


def test_a_message_of_another_version_is_not_played_as_one_of_today(tmp_path: Path):
    writer = BagWriter(tmp_path / "run")
    older = replace(spec("/a", TEXT), definition="string before\n")
    writer.write(older, START, START, string("a"))
    with pytest.raises(BagError, match=f"another version of {TEXT} than is installed"):
        play(writer.close())


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ({"topics": ["/c"]}, "no topic /c, only /a, /b"),
        ({"remap": {"/a": "/b"}}, "both be played on /b"),
        ({"start": 2.0, "stop": 1.0}, "nothing lies between"),
        ({"start": 3.0}, "nothing lies between"),
    ],
)
def test_what_cannot_be_played_is_named(bag: Path, wanted, message):
    with pytest.raises(BagError, match=message):
        play(bag, **wanted)
