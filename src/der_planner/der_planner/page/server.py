"""The page's HTTP server: live data, pictures, the vent button, log-in."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import parse_qs

import uvicorn
from fastapi import Depends, FastAPI, Request, Response, WebSocket, WebSocketDisconnect
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, RedirectResponse
from fastapi.staticfiles import StaticFiles

from der_planner.limb import LimbError
from der_planner.page.access import Binding, Sessions, bracketed
from der_planner.page.afterwards.experiments import Experiments
from der_planner.page.commands import Commands, Load, answer_of
from der_planner.page.drawing.studio import Studio
from der_planner.page.guard import COOKIE, LOGIN, Guard
from der_planner.page.operators import Desk
from der_planner.page.overlay import Overlay
from der_planner.page.picture import PictureFeed
from der_planner.page.situation import Situation
from der_planner.page.worker import Worker

STATIC = Path(__file__).parent / "static"
RATE = 10.0
"""Hz of the live data."""
LONGEST_TIME = 30
"""Characters of the time that a window says."""
LONGEST_WAIT = 1.0
"""[s] that a request for a picture may wait for the next one."""
WRONG_PASSWORD_DELAY = 1.0
"""[s] during which no other password is tried."""


@dataclass(frozen=True)
class Parts:
    """What the server shows and commands."""

    situation: Situation
    picture: PictureFeed
    overlay: Overlay
    desk: Desk
    commands: Commands
    studio: Studio
    experiments: Experiments
    replayer: Worker


class Bell:
    """Wakes what waits in the server's loop, from any thread."""

    def __init__(self) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._waiting: set[asyncio.Future[None]] = set()

    def ring(self) -> None:
        """Wake all that wait."""
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._wake)

    async def rung(self, patience: float) -> None:
        """Wait for the bell, for some seconds at most; not at all if they are not above zero."""
        if not patience > 0.0:
            return
        self._loop = asyncio.get_running_loop()
        ringing = self._loop.create_future()
        self._waiting.add(ringing)
        try:
            await asyncio.wait([ringing], timeout=patience)
        finally:
            self._waiting.discard(ringing)

    def _wake(self) -> None:
        for ringing in self._waiting:
            if not ringing.done():
                ringing.set_result(None)


class LiveText:
    """The live data as JSON, made once for all browsers."""

    def __init__(self, parts: Parts, clock: Callable[[], float] = time.monotonic) -> None:
        self._parts = parts
        self._clock = clock
        self._made = -1e9
        self._text = ""
        self._count = 0

    def __call__(self) -> str:
        """Return the data of now, or those made less than half an interval ago."""
        now = self._clock()
        if now - self._made > 0.5 / RATE:
            self._made = now
            self._count += 1
            data = self._parts.situation.snapshot()
            data["count"] = self._count
            data["operator"] = self._parts.desk.operator is not None
            self._text = json.dumps(data, separators=(",", ":"), allow_nan=False)
        return self._text


class Asking:
    """A window's requests for live data, each with the time of its own clock.

    A window asks again when it has the answer, so that no more than one is under way: a slow
    connection delays data, but does not pile them up. The time and how long the request waited here
    go back with the answer: what else has passed on the window's clock is how old the data can be.
    """

    def __init__(self) -> None:
        self._asked = asyncio.Event()
        self._closed = False
        self._time, self._at = 0.0, 0.0

    async def listen(self, websocket: WebSocket) -> None:
        """Take requests until the window is gone."""
        try:
            while (message := await websocket.receive())["type"] != "websocket.disconnect":
                with contextlib.suppress(ValueError):  # no clock shows that
                    self._take(float((message.get("text") or "")[:LONGEST_TIME]))
        except (WebSocketDisconnect, RuntimeError):
            pass
        finally:
            self._closed = True
            self._asked.set()

    def _take(self, sent: float) -> None:
        if math.isfinite(sent):
            self._time, self._at = sent, time.monotonic()
            self._asked.set()

    async def asks(self) -> bool:
        """Wait for the next request; return False instead when the window is gone."""
        await self._asked.wait()
        self._asked.clear()
        return not self._closed

    def answer(self, data: str) -> str:
        """Return a JSON object with the request's time, and how long it waited [s]."""
        return f'{{"asked":{self._time!r},"waited":{time.monotonic() - self._at:.4f},{data[1:]}'


def create_app(parts: Parts, sessions: Sessions, secure: bool) -> FastAPI:
    """Return the application without its layout.

    Args:
        parts: what it shows and commands.
        sessions: who has given the password.
        secure: served by TLS, so that cookies never travel without it.
    """
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    app.mount("/static", StaticFiles(directory=STATIC))
    _add_live(app, parts)
    _add_picture(app, parts)

    @app.post("/vent")
    async def vent() -> JSONResponse:
        # Whoever sees the page may vent, operator or not.
        answer = await answer_of("vent", parts.commands.call("vent"))
        return JSONResponse({"success": answer.success, "message": answer.message})

    @app.get("/experiments/{name}/{inside:path}")
    async def experiment_file(name: str, inside: str) -> Response:
        found = await asyncio.to_thread(parts.experiments.file, name, inside)
        if found is None:
            return Response("no such file of an experiment", status_code=404)
        return FileResponse(found, headers=_UNCACHED)

    _add_login(app, sessions, secure)
    return app


_UNCACHED = {"Cache-Control": "no-store"}


def _add_live(app: FastAPI, parts: Parts) -> None:
    live = LiveText(parts)

    @app.websocket("/live")
    async def send_live(websocket: WebSocket) -> None:
        await websocket.accept()
        window = Asking()
        listening = asyncio.create_task(window.listen(websocket))
        due = time.monotonic()
        try:
            while await window.asks():
                await asyncio.sleep(due - time.monotonic())
                await websocket.send_text(window.answer(live()))
                # On a grid, so that what sending takes does not add up; nothing is made up for.
                due = max(due + 1.0 / RATE, time.monotonic())
        except (WebSocketDisconnect, RuntimeError):
            pass  # the browser has gone
        finally:
            listening.cancel()


def _add_picture(app: FastAPI, parts: Parts) -> None:
    bell = Bell()
    parts.picture.on_put = bell.ring

    @app.get("/picture")
    async def picture(
        load: Annotated[Load, Depends(_load)],
        after: int = 0,
        region: bool = False,
        width: int = 0,
        wait: float = 0.0,
    ) -> Response:
        begun = time.monotonic()
        if not parts.picture.look(after):
            await bell.rung(min(wait, LONGEST_WAIT))
        encoded = await asyncio.to_thread(parts.picture.take, after, width)
        if encoded is None:
            return Response(status_code=204)
        reference = parts.situation.reference_at(encoded.stamp)
        drawn = parts.overlay.at(encoded.stamp, reference)
        drawn |= {"number": encoded.number, "size": encoded.size}
        if region:
            drawn["region"] = await asyncio.to_thread(_region, parts, load)
        drawn["waited"] = round(time.monotonic() - begun, 4)
        head = json.dumps(drawn, separators=(",", ":")).encode()
        body = struct.pack(">I", len(head)) + head + encoded.jpeg
        return Response(body, media_type="application/octet-stream", headers=_UNCACHED)


def _load(payload: float = 0.0, payload_at: float = 0.0, mounting: str = "") -> Load:
    return Load(payload, payload_at, mounting)


def _region(parts: Parts, load: Load) -> list[list[list[float]]]:
    """Return the outlines of what the tip reaches under a load [px]; none if there is no such."""
    try:
        outlines = parts.studio.region(load)
    except LimbError:
        return []  # the form says what is wrong with it
    return [parts.overlay.pixels_of(outline) for outline in outlines]


def _add_login(app: FastAPI, sessions: Sessions, secure: bool) -> None:
    form = (STATIC / "login.html").read_text()
    trying = asyncio.Lock()

    @app.get(LOGIN)
    async def show_login() -> HTMLResponse:
        return HTMLResponse(form.replace("{reason}", ""), headers=_UNCACHED)

    @app.post(LOGIN)
    async def log_in(request: Request) -> Response:
        body = (await request.body())[:4096].decode(errors="replace")
        password = parse_qs(body).get("password", [""])[0]
        async with trying:
            token = sessions.open(password)
            if token is None:
                await asyncio.sleep(WRONG_PASSWORD_DELAY)
        if token is None:
            text = form.replace("{reason}", "Wrong password.")
            return HTMLResponse(text, status_code=403, headers=_UNCACHED)
        answer = RedirectResponse("/", status_code=303)
        # It ends with the browser, and here when it is not used: see `SESSION_LIFE`.
        answer.set_cookie(COOKIE, token, httponly=True, secure=secure, samesite="strict")
        return answer


class PageServer:
    """Serves the page from a thread of its own.

    Args:
        binding: where, checked.
        listener: bound socket.
        parts: what it shows and commands.
        lay_out: adds the layout to the application.
    """

    def __init__(
        self,
        binding: Binding,
        listener: socket.socket,
        parts: Parts,
        lay_out: Callable[[FastAPI, Parts], None],
    ) -> None:
        self.port: int = listener.getsockname()[1]
        self.url = f"{binding.scheme}://{bracketed(binding.address)}:{self.port}"
        sessions = Sessions(binding.password)
        app = create_app(parts, sessions, secure=bool(binding.certificate))
        lay_out(app, parts)
        self.guard = Guard(app, binding.hosts(self.port), binding.scheme, sessions)
        self.error: BaseException | None = None
        self._listener = listener
        options: dict[str, Any] = {}
        if binding.certificate:
            options = {"ssl_certfile": binding.certificate, "ssl_keyfile": binding.private_key}
        self._server = uvicorn.Server(
            uvicorn.Config(
                self.guard,
                log_level=logging.WARNING,
                access_log=False,
                server_header=False,
                proxy_headers=False,
                ws_ping_interval=1.0,
                ws_ping_timeout=2.0,
                ws_per_message_deflate=False,  # it costs more time than it saves on a local network
                timeout_graceful_shutdown=1,
                lifespan="on",
                **options,
            )
        )
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()

    @property
    def ready(self) -> bool:
        """Whether requests are answered."""
        return self._server.started

    def close(self) -> None:
        """Stop serving; returns when the port is free, after 5 s at most."""
        self._server.should_exit = True
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)
        self._listener.close()

    def _run(self) -> None:
        try:
            self._server.run(sockets=[self._listener])
        except BaseException as error:  # the node must hear of it, SystemExit too
            self.error = error
