"""Order, pace and choice of a replay, on a clock that does not wait."""

from pathlib import Path

import pytest
from bags import SECOND, START, TEXT, spec, string

from der_planner.bags.reader import BagError, BagReader
from der_planner.bags.replay import ReplaySettings, replay
from der_planner.bags.writer import BagWriter


class Stage:
    """Collects what is published, on a clock that only its own sleeps move."""

    def __init__(self) -> None:
        self.now = 100.0
        self.events: list[tuple[float, str, object]] = []

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0
        self.now += seconds

    def publish(self, topic, message) -> None:
        self.events.append((self.now - 100.0, topic, message.data))

    def show_time(self, now: int) -> None:
        self.events.append((self.now - 100.0, "/clock", now))

    def of(self, topic: str) -> list[tuple[float, object]]:
        return [(when, what) for when, name, what in self.events if name == topic]


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    writer = BagWriter(tmp_path / "run", split_seconds=1.0)
    for index in range(20):
        when = START + index * SECOND // 10
        writer.write(spec("/a", TEXT), when, when, string(f"a{index}"))
        writer.write(spec("/b", TEXT), when + 5, when, string(f"b{index}"))
    return writer.close()


def play(path: Path, **settings) -> Stage:
    stage = Stage()
    with BagReader(path) as reader:
        replay(
            reader,
            ReplaySettings(**settings),
            stage,
            clock=lambda: stage.now,
            sleep=stage.sleep,
        )
    return stage


def test_pace_order_and_clock(bag: Path):
    stage = play(bag, rate=2.0)
    assert [data for _, data in stage.of("/a")] == [string(f"a{i}") for i in range(20)]
    for index, (when, _) in enumerate(stage.of("/a")):
        assert when == pytest.approx(index * 0.05, abs=1e-6)
    times = [what for _, what in stage.of("/clock")]
    assert times == sorted(times)
    assert len(times) > 150  # 1.9 s at 100 Hz
    shown = START
    for _, topic, what in stage.events:
        if topic == "/clock":
            shown = what
        elif topic == "/a":
            index = [string(f"a{i}") for i in range(20)].index(what)
            assert shown == START + index * SECOND // 10


def test_rate_zero_does_not_wait(bag: Path):
    stage = play(bag, rate=0.0)
    assert stage.now == 100.0
    assert len(stage.of("/b")) == 20


def test_part_choice_and_names(bag: Path):
    stage = play(bag, start=0.5, stop=1.0, topics=["/a"], remap={"/a": "/again"})
    assert [data for _, data in stage.of("/again")] == [string(f"a{i}") for i in range(5, 10)]
    assert stage.of("/b") == []
    assert stage.of("/again")[0][0] == pytest.approx(0.0)
    assert play(bag, exclude=["/a"]).of("/a") == []


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"topics": ["/c"]}, "no topic /c, only /a, /b"),
        ({"remap": {"/a": "/b"}}, "both be played on /b"),
        ({"rate": -1.0}, "rate must be"),
        ({"start": 2.0, "stop": 1.0}, "nothing lies between"),
    ],
)
def test_impossible_settings_are_named(bag: Path, settings, message):
    with pytest.raises(BagError, match=message):
        play(bag, **settings)
