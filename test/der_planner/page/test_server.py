"""The page's server as a window meets it: vent, live data, pictures, the reachable region."""

from __future__ import annotations

import json
import struct
import threading
import time
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from apriltag_tracker.tag_map import LimbTag, TagMap
from der_planner.limb import Limb, Load
from der_planner.page.access import Desk
from der_planner.page.commands import Commands
from der_planner.page.drawing import DrawingFolder, Previewer
from der_planner.page.picture import Overlay, PictureFeed
from der_planner.page.server import Parts, create_app
from der_planner.page.situation import Situation
from der_planner.planning import PathLimits

GREY: Any = np.full((72, 128), 90, dtype=np.uint8)


class Driver:
    """Stands in for the page's node; the graph's services answer from here, or not at all."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.answers = True

    def create_client(self, _: object, service: str) -> Any:
        def call(_: object) -> Future[Any]:
            self.calls.append(service)
            answer: Future[Any] = Future()
            if self.answers:
                answer.set_result(SimpleNamespace(success=True, message="vented"))
            return answer

        return SimpleNamespace(service_is_ready=lambda: True, call_async=call)

    def create_publisher(self, *_: object) -> None:
        return None


@pytest.fixture
def driver() -> Driver:
    return Driver()


@pytest.fixture
def parts(driver: Driver) -> Parts:
    return Parts(
        situation=(situation := Situation()),
        picture=PictureFeed(15.0),
        overlay=Overlay(TagMap((0.12, 0.12), (LimbTag(0, 0.2, 0.03, 0.015),), ())),
        desk=Desk(),
        commands=Commands(driver, situation, 2),  # type: ignore[arg-type]
        previewer=Previewer(Limb.default(), PathLimits(), Load()),
        drawings=DrawingFolder(Path("nowhere")),
    )


@pytest.fixture
def client(parts: Parts) -> TestClient:
    return TestClient(create_app(parts))


def test_everybody_vents(client: TestClient, driver: Driver) -> None:
    assert client.post("/vent").json() == {"success": True, "message": "vented"}
    assert driver.calls == ["pressure_driver/vent"]


def test_a_driver_that_does_not_answer_is_no_vent(
    client: TestClient, driver: Driver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("der_planner.page.commands.PATIENCE", 0.05)
    driver.answers = False
    answer = client.post("/vent").json()
    assert not answer["success"]
    assert "NOT VENTED" in answer["message"]


def test_live_data_come_ten_times_a_second_and_tell_their_age(client: TestClient) -> None:
    begun = time.monotonic()
    with client.websocket_connect("/live") as live:
        for odd in ("", "now", "nan", "1e999"):
            live.send_text(odd)  # no time, no answer
        for asked in (7.5, 12.5, 3.25, 4.0, 5.0):
            live.send_text(str(asked))
            answer = live.receive_json()
            assert answer["asked"] == asked
            assert 0.0 <= answer["waited"] <= time.monotonic() - begun
        assert time.monotonic() - begun >= 0.39
    assert not answer["sources"]["driver"]["fresh"]


def test_live_data_are_a_sign_of_life_of_the_operator(client: TestClient, parts: Parts) -> None:
    with client.websocket_connect("/live") as live:
        for request in ("1 window tab", "2 another other", "3 again tab", "4 again tab"):
            live.send_text(request)
            live.receive_json()
            assert parts.desk.take("window") == ("again" not in request)
    assert parts.desk.operator == "again"


@pytest.mark.slow
def test_a_request_waits_for_the_next_picture(client: TestClient, parts: Parts) -> None:
    with client:
        assert client.get("/picture").status_code == 204
        assert parts.picture.due()  # a picture is made only if somebody looks
        parts.picture.put(5, GREY)
        assert client.get("/picture?wait=1").status_code == 200
        coming = threading.Timer(0.2, parts.picture.put, (6, GREY))
        coming.start()
        answer = client.get("/picture?after=1&wait=30")
        coming.join()
        begun = time.monotonic()
        for wait in ("30", "nan"):  # nobody holds a request for as long as it likes
            assert client.get(f"/picture?after=2&wait={wait}").status_code == 204
    assert 0.5 < time.monotonic() - begun < 20.0
    size = struct.unpack(">I", answer.content[:4])[0]
    assert json.loads(answer.content[4 : 4 + size])["number"] == 2
    assert answer.content[4 + size : 6 + size] == b"\xff\xd8"


@pytest.mark.parametrize("load", ["mounting=upside", "payload=0.02&payload_at=9"])
def test_there_is_no_region_under_a_load_that_cannot_be(client: TestClient, load: str) -> None:
    assert client.get(f"/region?{load}").json() == []
