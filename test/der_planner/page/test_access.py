"""The page's server: where it listens, whom it lets in, who commands, and what a window gets."""

from __future__ import annotations

import json
import socket
import struct
import threading
import time
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fastapi import FastAPI, WebSocket
from fastapi.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from waiting import Clock

from apriltag_tracker.tag_map import LimbTag, TagMap
from der_planner.limb import Limb, Load
from der_planner.page.access import (
    KEPT,
    AccessError,
    AccessFilter,
    Binding,
    Desk,
)
from der_planner.page.commands import Commands
from der_planner.page.drawing import DrawingFolder, Previewer
from der_planner.page.picture import Overlay, PictureFeed
from der_planner.page.server import Parts, create_app
from der_planner.page.situation import Situation
from der_planner.planning import PathLimits

TOKEN = "a token of this test"
HOST = "127.0.0.1:8080"
ORIGIN = f"http://{HOST}"
SOCKET = f"ws://{HOST}/live"
"""The test client asks for websockets of another host unless it is told."""


@pytest.fixture
def access() -> AccessFilter:
    app = FastAPI()
    app.get("/read")(lambda: "data")
    app.post("/vent")(lambda: "vented")

    @app.websocket("/live")
    async def live(websocket: WebSocket) -> None:
        await websocket.accept()

    return AccessFilter(app, Binding(token=TOKEN), 8080)


def visitor(access: AccessFilter, cookie: bool = True, **headers: str) -> TestClient:
    found = TestClient(access, base_url=ORIGIN, headers=headers, follow_redirects=False)
    if cookie:
        found.cookies.set("limb_token_8080", TOKEN, domain="127.0.0.1")
    return found


@pytest.mark.parametrize(
    ("given", "message"),
    [({"address": "localhost:8080"}, "no IP address"), ({"token": "short"}, "12 or more")],
)
def test_what_protects_nothing_is_refused(given: dict[str, str], message: str) -> None:
    with pytest.raises(AccessError, match=message):
        Binding(**given)


def test_a_taken_port_is_named_with_the_remedy() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(AccessError, match=rf"in use .*{port}.*set the parameter 'port'"):
            Binding(port=port).listen()


def test_the_address_with_the_token_opens_the_page_and_is_remembered(access: AccessFilter) -> None:
    browser = visitor(access, cookie=False, origin=ORIGIN)
    for path in ("/read", "/read?token=of another page", "/read?token=ä"):
        assert browser.get(path).status_code == 401
    assert browser.post("/vent").status_code == 401
    assert browser.post(f"/vent?token={TOKEN}").status_code == 401  # a command is no first visit
    with pytest.raises(WebSocketDisconnect), browser.websocket_connect(SOCKET):
        pass
    answer = browser.get(f"/read?token={TOKEN}")
    # Whatever a proxy is called.
    assert (answer.status_code, answer.headers["location"]) == (303, "/read")
    assert "HttpOnly" in answer.headers["set-cookie"]
    assert browser.get("/read").status_code == 200
    assert browser.post("/vent").status_code == 200
    with browser.websocket_connect(SOCKET):
        pass


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": "http://127.0.0.1:9999"},
        {"origin": f"{ORIGIN}.evil.example"},
        {},  # no browser sends a command without an origin
        {"host": "evil.example:8080", "origin": "http://evil.example:8080"},
    ],
)
def test_a_page_elsewhere_neither_vents_nor_listens(
    access: AccessFilter, headers: dict[str, str]
) -> None:
    elsewhere = visitor(access, **headers)
    assert elsewhere.post("/vent").status_code == 403
    with pytest.raises(WebSocketDisconnect), elsewhere.websocket_connect(SOCKET):
        pass
    assert access.refused == 2


@pytest.mark.parametrize("host", ["evil.example:8080", "127.0.0.1.evil.example:8080", "[::1"])
def test_reading_by_another_name_is_refused(access: AccessFilter, host: str) -> None:
    answer = visitor(access, host=host).get("/read")
    assert answer.status_code == 403
    assert "host_names" in answer.text


def test_other_pages_read_nothing_but_may_link_here(access: AccessFilter) -> None:
    for site, mode, status in (("same-site", "no-cors", 403), ("cross-site", "navigate", 200)):
        headers = {"sec-fetch-site": site, "sec-fetch-mode": mode}
        answer = visitor(access, **headers).get("/read")
        assert answer.status_code == status
        assert answer.headers["x-frame-options"] == "DENY"
        assert "default-src 'self'" in answer.headers["content-security-policy"]


def test_one_commands_and_others_watch() -> None:
    clock = Clock()
    desk = Desk(clock)
    desk.hear("a", "tab 1")
    desk.hear("b", "tab 2")
    assert desk.silence is None
    assert desk.take("a")
    assert not desk.take("b")
    assert (desk.may_command("a"), desk.may_command("b")) == (True, False)
    clock.now += 1.0
    desk.hear("b", "tab 2")
    assert desk.silence == 1.0
    desk.hear("c", "tab 1")  # a copy of the tab: the first window is still there
    assert desk.operator == "a"
    clock.now += 0.1
    desk.hear("c", "tab 1")  # the first window was left: it was loaded anew
    assert (desk.operator, desk.silence) == ("c", 0.0)
    desk.hear("a", "tab 1")
    assert desk.operator == "c"
    desk.leave("c")
    assert (desk.operator, desk.silence) == (None, None)


def test_the_desk_is_kept_for_a_while() -> None:
    clock = Clock()
    desk = Desk(clock)
    desk.hear("a", "tab 1")
    desk.take("a")
    clock.now += KEPT - 0.1
    assert not desk.take("b")
    desk.hear("again", "tab 1")
    assert desk.operator == "again"
    clock.now += KEPT + 0.1
    desk.hear("again", "tab 1")  # a browser that was asleep does not get it back by itself
    assert desk.operator is None
    assert desk.take("b")
    desk.hear("again", "tab 1")
    assert desk.operator == "b"


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
        commands=Commands(driver, situation),  # type: ignore[arg-type]
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


def test_live_data_are_a_sign_of_life_of_the_operator(
    client: TestClient, parts: Parts, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("der_planner.page.access.LOADED_ANEW", 0.0)
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
