"""The page's server as a browser, and as a hostile page elsewhere, meets it."""

from __future__ import annotations

import json
import struct
import threading
import time
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from apriltag_tracker.tag_map import LimbTag, TagMap
from der_planner.limb import Limb
from der_planner.page.access import Binding, Sessions
from der_planner.page.afterwards.experiments import Experiments
from der_planner.page.commands import Answer, Conditions, MotionRequest, Service
from der_planner.page.drawing.studio import Studio
from der_planner.page.guard import Guard
from der_planner.page.operators import Desk
from der_planner.page.overlay import Overlay
from der_planner.page.picture import PictureFeed
from der_planner.page.server import Parts, create_app
from der_planner.page.situation import Situation
from der_planner.page.worker import Worker
from der_planner.planning import PathLimits

HOST = "127.0.0.1:8080"
ORIGIN = f"http://{HOST}"
SOCKET = f"ws://{HOST}"
"""The test client asks for websockets of another host unless it is told."""
PASSWORD = "correct horse battery"
TAGS = TagMap((0.12, 0.12), (LimbTag(0, 0.2, 0.03, 0.015),), ())


class Calls:
    """Notes what the server asks for; answers like the driver, or not at all."""

    def __init__(self) -> None:
        self.services: list[Service] = []
        self.answers = True

    def call(self, service: Service) -> Future[Answer]:
        self.services.append(service)
        answer: Future[Answer] = Future()
        if self.answers:
            answer.set_result(Answer(True, "vented"))
        return answer

    def play(self, request: MotionRequest) -> Answer:
        return Answer(True, request.motion)

    def fill(self, segment: int, side: int, pressure: float) -> Answer:
        raise NotImplementedError

    def play_path(self, tip: Any, conditions: Conditions) -> Answer:
        return Answer(True, "path")

    def learned_plans(self) -> list[str]:
        return []

    def record(self, note: str) -> Future[Answer]:
        return self.call("record_start")


class Rig:
    def __init__(self, password: str = "") -> None:
        self.calls = Calls()
        self.situation = Situation()
        self.picture = PictureFeed(15.0)
        desk = Desk(lambda _: None)
        studio = Studio(Limb.default(), PathLimits(), Path("nowhere"))
        parts = Parts(
            self.situation,
            self.picture,
            Overlay(TAGS),
            desk,
            self.calls,
            studio,
            Experiments(Path("none")),
            Worker(),
        )
        sessions = Sessions(password)
        self.app: FastAPI = create_app(parts, sessions, secure=False)
        self.guard = Guard(self.app, Binding().hosts(8080), "http", sessions)

    def client(self, **headers: str) -> TestClient:
        return TestClient(self.guard, base_url=ORIGIN, headers=headers, follow_redirects=False)


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_the_page_itself_vents(rig: Rig) -> None:
    answer = rig.client(origin=ORIGIN).post("/vent")
    assert answer.json() == {"success": True, "message": "vented"}
    assert rig.calls.services == ["vent"]


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": "http://127.0.0.1:9999"},
        {},  # no browser sends a command without an origin
        {"host": "evil.example", "origin": "http://evil.example"},
        {"host": "evil.example:8080", "origin": "http://evil.example:8080"},
    ],
)
def test_a_page_elsewhere_neither_vents_nor_listens(rig: Rig, headers: dict[str, str]) -> None:
    client = rig.client(**headers)
    assert client.post("/vent").status_code == 403
    for path in ("/live", "/_nicegui_ws/socket.io/"):
        with pytest.raises(WebSocketDisconnect), client.websocket_connect(SOCKET + path):
            pass
    assert not rig.calls.services
    assert rig.guard.refused == 3


@pytest.mark.parametrize("host", ["evil.example:8080", "127.0.0.1.evil.example:8080", "127.0.0.1"])
def test_reading_by_another_name_is_refused(rig: Rig, host: str) -> None:
    answer = rig.client(host=host).get("/picture")
    assert answer.status_code == 403
    assert "host_names" in answer.text


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_other_pages_read_nothing_but_may_link_here(rig: Rig, site: str) -> None:
    reading = {"sec-fetch-site": site, "sec-fetch-mode": "no-cors"}
    assert rig.client(**reading).get("/picture").status_code == 403
    following = {"sec-fetch-site": site, "sec-fetch-mode": "navigate"}
    assert rig.client(**following).get("/picture").status_code == 204
    own = {"sec-fetch-site": "same-origin", "sec-fetch-mode": "cors"}
    assert rig.client(**own).get("/picture").status_code == 204


def test_answers_forbid_frames_and_other_machines(rig: Rig) -> None:
    headers = rig.client().get("/static/live.js").headers
    assert headers["x-frame-options"] == "DENY"
    assert "default-src 'self'" in headers["content-security-policy"]
    assert "frame-ancestors 'none'" in headers["content-security-policy"]


def test_live_data_come_ten_times_a_second(rig: Rig) -> None:
    counts = []
    with rig.client(origin=ORIGIN).websocket_connect(SOCKET + "/live") as live:
        begun = time.monotonic()
        for _ in range(5):
            live.send_text("7.5")
            counts.append(live.receive_json()["count"])
        assert time.monotonic() - begun >= 0.39
    assert counts == sorted(set(counts))


def test_data_do_not_pile_up_on_a_slow_way_and_tell_their_age(rig: Rig) -> None:
    with rig.client(origin=ORIGIN).websocket_connect(SOCKET + "/live") as live:
        for odd in ("", "now", "nan", "1e999"):
            live.send_text(odd)  # no time, no answer
        live.send_text("12.5")
        first = live.receive_json()
        time.sleep(0.35)  # three intervals during which the window does not ask
        live.send_text("100.25")
        begun = time.monotonic()
        second = live.receive_json()
    assert (first["asked"], second["asked"]) == (12.5, 100.25)
    assert second["count"] == first["count"] + 1
    assert 0.0 <= second["waited"] <= time.monotonic() - begun


def test_a_driver_that_does_not_answer_is_no_vent(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("der_planner.page.commands.PATIENCE", 0.05)
    rig.calls.answers = False
    answer = rig.client(origin=ORIGIN).post("/vent").json()
    assert not answer["success"]
    assert "NOT VENTED" in answer["message"]


def test_a_password_is_asked_for_everywhere() -> None:
    rig = Rig(PASSWORD)
    client = rig.client(origin=ORIGIN)
    assert client.get("/picture").headers["location"] == "/login"
    assert client.post("/vent").status_code == 401
    with pytest.raises(WebSocketDisconnect), client.websocket_connect(SOCKET + "/live"):
        pass
    begin = time.monotonic()
    assert client.post("/login", data={"password": "wrong guess here"}).status_code == 403
    assert time.monotonic() - begin >= 1.0
    assert client.post("/login", data={"password": PASSWORD}).status_code == 303
    assert client.post("/vent").json()["success"]
    assert rig.calls.services == ["vent"]


def test_a_window_that_only_listens_stays_logged_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("der_planner.page.access.SESSION_LIFE", 0.5)
    client = Rig(PASSWORD).client(origin=ORIGIN)
    client.post("/login", data={"password": PASSWORD})
    with client.websocket_connect(SOCKET + "/live") as live:
        for _ in range(10):
            live.send_text("1.0")
            live.receive_json()
        assert client.post("/vent").json()["success"]
    time.sleep(0.6)
    assert client.post("/vent").status_code == 401


def test_a_picture_is_made_only_if_somebody_looks(rig: Rig) -> None:
    grey: Any = np.full((72, 128), 90, dtype=np.uint8)
    assert not rig.picture.due()
    client = rig.client()
    assert client.get("/picture").status_code == 204
    assert rig.picture.due()
    rig.picture.put(5, grey)
    body = client.get("/picture").content
    size = struct.unpack(">I", body[:4])[0]
    assert body[4 + size : 6 + size] == b"\xff\xd8"
    assert client.get("/picture?after=1").status_code == 204


def test_a_request_waits_for_the_next_picture(rig: Rig) -> None:
    first, second = (np.full((72, 128), shade, dtype=np.uint8) for shade in (90, 200))
    rig.picture.put(5, first)
    client = rig.client()
    with client:
        assert client.get("/picture?wait=1").status_code == 200
        coming = threading.Timer(0.2, rig.picture.put, (6, second))
        coming.start()
        answer = client.get("/picture?after=1&wait=30")
        coming.join()
        begun = time.monotonic()
        assert client.get("/picture?after=2&wait=30").status_code == 204
    assert 0.5 < time.monotonic() - begun < 20.0  # nobody holds a request for as long as it likes
    size = struct.unpack(">I", answer.content[:4])[0]
    assert json.loads(answer.content[4 : 4 + size])["number"] == 2


def test_a_small_window_gets_a_small_file_that_is_made_once(rig: Rig) -> None:
    random = np.random.default_rng(0)
    rig.picture.put(5, random.integers(0, 255, (720, 1280), dtype=np.uint8))
    whole, half = rig.picture.take(0), rig.picture.take(0, shown=700)
    assert whole is not None
    assert half is not None
    assert half.size == whole.size == (1280, 720)  # what is drawn over it is in the camera's pixels
    shapes = [
        cv2.imdecode(np.frombuffer(one.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE).shape
        for one in (whole, half)
    ]
    assert shapes == [(720, 1280), (360, 640)]
    assert rig.picture.take(0, shown=640) is half
    assert rig.picture.take(0, shown=2000) is whole
