"""Where the page may listen, whom it lets in, and who commands."""

from __future__ import annotations

import socket

import pytest
from fastapi import FastAPI, WebSocket
from fastapi.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from waiting import Clock

from der_planner.page.access import (
    KEPT,
    AccessError,
    AccessFilter,
    Binding,
    Desk,
)

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


def client(access: AccessFilter, cookie: bool = True, **headers: str) -> TestClient:
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
    browser = client(access, cookie=False, origin=ORIGIN)
    for path in ("/read", "/read?token=of another page", "/read?token=ä"):
        assert browser.get(path).status_code == 401
    assert browser.post("/vent").status_code == 401
    assert browser.post(f"/vent?token={TOKEN}").status_code == 401  # a command is no first visit
    with pytest.raises(WebSocketDisconnect), browser.websocket_connect(SOCKET):
        pass
    answer = browser.get(f"/read?token={TOKEN}")
    assert (answer.status_code, answer.headers["location"]) == (303, f"{ORIGIN}/read")
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
    elsewhere = client(access, **headers)
    assert elsewhere.post("/vent").status_code == 403
    with pytest.raises(WebSocketDisconnect), elsewhere.websocket_connect(SOCKET):
        pass
    assert access.refused == 2


@pytest.mark.parametrize("host", ["evil.example:8080", "127.0.0.1.evil.example:8080", "[::1"])
def test_reading_by_another_name_is_refused(access: AccessFilter, host: str) -> None:
    answer = client(access, host=host).get("/read")
    assert answer.status_code == 403
    assert "host_names" in answer.text


def test_other_pages_read_nothing_but_may_link_here(access: AccessFilter) -> None:
    for site, mode, status in (("same-site", "no-cors", 403), ("cross-site", "navigate", 200)):
        headers = {"sec-fetch-site": site, "sec-fetch-mode": mode}
        answer = client(access, **headers).get("/read")
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
    desk.hear("c", "tab 1")  # the window was loaded anew
    assert (desk.operator, desk.silence) == ("c", 0.0)
    desk.hear("a", "tab 1")  # a copy of the tab: the older window does not take over again
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
    assert desk.operator is None
    assert desk.take("b")
    desk.hear("again", "tab 1")
    assert desk.operator == "b"
