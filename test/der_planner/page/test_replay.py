"""Replay of a bag: each instant shows its own picture and curves; what is missing is said."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from filmed import FilmedRun, pixels
from runs import FRAMES, TIMES, BagOfRun, reference

from der_planner.bags.reader import BagError
from der_planner.page.afterwards.playback import Playback, describe
from der_planner.page.afterwards.replay import add_data
from der_planner.page.worker import Worker

SEEN = FRAMES[FRAMES >= 0]
OFFSET = np.array([0.0, 0.002])


def write_run(folder: Path, pictures: bool) -> Path:
    run = FilmedRun(folder, run=json.dumps({"note": "a good one"}))
    run.plan()
    run.calibration()
    random = np.random.default_rng(2)
    point = run.kinds["geometry_msgs/msg/PointStamped"]
    place = run.kinds["geometry_msgs/msg/Point"]
    for when in TIMES:
        x, y = reference(when)[0]
        run.put(
            "/limb/tip_reference", "geometry_msgs/msg/PointStamped", when,
            point(header=run.header(when), point=place(x=x, y=y, z=0.0)),
        )  # fmt: skip
        run.pressure(when, [1000.0 * when, 0.0], [900.0 * when, math.nan], mode=2 if when else 1)
    for index, when in enumerate(SEEN):
        run.state(when, reference(when)[0] + OFFSET, valid=index != 100)
        if index % 10 == 0:
            run.tags(when, random.uniform([0.0, -0.1], [0.24, 0.1], (5, 2)))
            if pictures:
                run.frame(when, shade=index % 250)
    run.bag.close()
    return folder


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("filmed") / "run", pictures=True)


def parts(frame: bytes) -> tuple[dict[str, Any], bytes]:
    size = int.from_bytes(frame[:4], "big")
    return json.loads(frame[4 : 4 + size]), frame[4 + size :]


def test_each_instant_shows_its_own_picture_and_its_own_limb(bag: Path) -> None:
    playback = Playback(str(bag))
    begin = min(float(SEEN[0]), 0.0)
    for index in (30, 150, 60):  # back again, too
        over, jpeg = parts(playback.frame(float(SEEN[index]) - begin + 0.004))
        shade = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE).mean()
        assert shade == pytest.approx(index, abs=1.5)
        assert over["size"] == [320, 240]
        wanted = pixels((reference(SEEN[index])[0] + OFFSET)[None])[0]
        assert over["tip"] == pytest.approx(wanted, abs=0.2)
        assert len(over["path"]) > 50
        assert len(over["tags"]) == 5
    over, _ = parts(playback.frame(float(SEEN[100]) - begin))
    assert (over["tip"], over["curve"]) == (None, [])


def test_the_curves_are_those_of_the_bag(bag: Path) -> None:
    found = json.loads(describe(str(bag)))
    assert found["duration"] == pytest.approx(max(TIMES[-1], SEEN[-1]), abs=0.05)
    assert "a good one" in found["about"]
    assert [entry[1] for entry in found["driver"]["modes"]] == ["armed", "tracking"]
    assert found["driver"]["measured"][40] == [pytest.approx(0.9 * TIMES[40], abs=1e-3), None]
    errors = found["limb"]["error"]
    assert errors[100] is None
    # The reference is interpolated between setpoints of 50 ms.
    assert errors[50] == [pytest.approx(0.2, abs=0.02)]
    assert found["notes"] == []


def test_what_a_bag_lacks_is_said_and_the_rest_is_shown(bag: Path, tmp_path: Path) -> None:
    without = Playback(str(write_run(tmp_path / "without", pictures=False)))
    assert any("no camera pictures" in note for note in without.describe()["notes"])
    over, jpeg = parts(without.frame(3.0))
    assert jpeg == b""
    assert over["tip"] is not None

    cut = tmp_path / "cut"
    cut.mkdir()
    whole = next(bag.glob("*.mcap")).read_bytes()
    (cut / "cut_0.mcap").write_bytes(whole[: len(whole) * 6 // 10])
    playback = Playback(str(cut))
    found = playback.describe()
    assert 10 < len(found["limb"]["at"]) < len(SEEN)
    assert any("before it could close" in note for note in found["notes"])
    assert parts(playback.frame(1.0))[1]

    plain = BagOfRun(tmp_path / "plain")
    for when in SEEN:
        plain.state(when, reference(when)[0])
    plain.bag.close()
    over, jpeg = parts(Playback(str(tmp_path / "plain")).frame(2.0))
    assert jpeg == b""
    x, y = over["tip"]
    assert 0 < x < over["size"][0]
    assert 0 < y < over["size"][1]


def test_what_is_no_bag_is_refused(tmp_path: Path) -> None:
    text = tmp_path / "text.mcap"
    text.write_text("no bag")
    empty = BagOfRun(tmp_path / "empty")
    empty.plan()
    empty.bag.close()
    for path in (text, tmp_path / "nowhere", tmp_path / "empty", tmp_path):
        with pytest.raises(BagError):
            Playback(str(path))


@pytest.fixture
def worker() -> Iterator[Worker]:
    running = Worker()
    yield running
    running.close()


def test_a_window_fetches_curves_and_frames_or_reads_why_not(bag: Path, worker: Worker) -> None:
    app = FastAPI()
    add_data(app, SimpleNamespace(replayer=worker))  # type: ignore[arg-type]
    # One thread for all requests, as in the server: the process ends with the thread it came from.
    with TestClient(app) as client:
        look_and_break(client, bag, worker)


def look_and_break(client: TestClient, bag: Path, worker: Worker) -> None:
    answer = client.get("/replay/data", params={"bag": str(bag)})
    assert answer.status_code == 200, answer.text
    assert answer.json()["pictures"] is True
    frame = client.get("/replay/frame", params={"bag": str(bag), "at": 2.0})
    assert frame.status_code == 200, frame.text
    assert len(parts(frame.content)[1]) > 100
    missing = client.get("/replay/data", params={"bag": "/nowhere"})
    assert (missing.status_code, missing.text) == (422, "no bag at /nowhere")

    # A process that is gone is said to be gone, and the next request gets a new one.
    for process in (worker._pool._processes or {}).values():  # type: ignore[union-attr]
        process.kill()
    deadline = time.monotonic() + 60.0
    while client.get("/replay/data", params={"bag": str(bag)}).status_code != 200:
        assert time.monotonic() < deadline
