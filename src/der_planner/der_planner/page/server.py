"""The page's HTTP server: live data, pictures, and the vent button."""

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

import uvicorn
from fastapi import FastAPI, Response, WebSocket, WebSocketDisconnect
from fastapi.responses import JSONResponse
from fastapi.staticfiles import StaticFiles

from der_planner.limb import LimbError, Load
from der_planner.page.access import AccessFilter, Binding, Desk
from der_planner.page.commands import Commands
from der_planner.page.drawing import DrawingFolder, Previewer
from der_planner.page.picture import Overlay, PictureFeed
from der_planner.page.situation import Situation

STATIC = Path(__file__).parent / "static"
RATE = 10.0
"""Live data are sent at this rate [Hz]."""
LONGEST_ASK = 200
"""What a window asks with has at most this many characters."""
LONGEST_WAIT = 1.0
"""A request for a picture may wait for the next one during this time [s]."""
PICTURE_POLL = 0.01
"""A waiting request looks for a new picture at this interval [s]."""
REPORT = "report.html"
"""The file of an experiment's report in its folder."""
UNCACHED = {"Cache-Control": "no-store"}


@dataclass(frozen=True)
class Parts:
    """What the page shows and commands."""

    situation: Situation
    picture: PictureFeed
    overlay: Overlay
    desk: Desk
    commands: Commands
    previewer: Previewer
    drawings: DrawingFolder
    report: Path | None = None


def create_app(parts: Parts) -> FastAPI:
    """Return the application without its layout."""
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    app.mount("/static", StaticFiles(directory=STATIC))
    if parts.report is not None:
        parts.report.mkdir(parents=True, exist_ok=True)
        app.mount("/report", StaticFiles(directory=parts.report))
    _add_live_data(app, parts)
    _add_picture(app, parts)

    @app.post("/vent")
    async def vent() -> dict[str, bool | str]:
        # Whoever sees the page may vent, operator or not.
        answer = await parts.commands.call("vent")
        return {"success": answer.success, "message": answer.message}

    return app


def _add_live_data(app: FastAPI, parts: Parts) -> None:
    """Add the websocket of the live data.

    A window sends the time of its own clock, its name and its tab, and asks again when it has the
    answer: a slow connection delays data, but does not pile them up. The time and how long the
    request waited here go back with the answer: what else has passed on the window's clock is how
    old the data can be. Each request is a sign of life of the browser.
    """

    @app.websocket("/live")
    async def send_live(websocket: WebSocket) -> None:
        await websocket.accept()
        due = time.monotonic()
        # Either is raised when the browser has gone.
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            while True:
                asked, window, tab = _read_request(await websocket.receive_text())
                if asked is None:
                    continue
                parts.desk.hear(window, tab)
                came = time.monotonic()
                await asyncio.sleep(due - came)
                waited = round(time.monotonic() - came, 4)
                data = {"asked": asked, "waited": waited, **parts.situation.snapshot()}
                data["report"] = bool(parts.report and (parts.report / REPORT).is_file())
                await websocket.send_text(json.dumps(data, separators=(",", ":"), allow_nan=False))
                # On a grid, so that what sending takes does not add up; nothing is made up for.
                due = max(due + 1.0 / RATE, time.monotonic())


def _read_request(text: str) -> tuple[float | None, str, str]:
    """Return the time that a window sent, None if no clock shows that; its name, and its tab."""
    said, window, tab = [*text[:LONGEST_ASK].split(" "), "", ""][:3]
    try:
        sent = float(said)
    except ValueError:
        sent = math.nan
    return sent if math.isfinite(sent) else None, window, tab


def _add_picture(app: FastAPI, parts: Parts) -> None:
    @app.get("/picture")
    async def picture(after: int = 0, width: int = 0, wait: float = 0.0) -> Response:
        """Answer with four bytes of length, the overlay as JSON, and the picture as JPEG."""
        begun = time.monotonic()
        while not parts.picture.has_newer(after):
            # NaN, too, ends the waiting.
            if not time.monotonic() - begun < min(wait, LONGEST_WAIT):
                return Response(status_code=204)
            await asyncio.sleep(PICTURE_POLL)
        encoded = await asyncio.to_thread(parts.picture.take, width)
        drawn = parts.overlay.at(encoded.stamp, parts.situation.reference_at(encoded.stamp))
        drawn |= {"number": encoded.number, "size": encoded.size}
        drawn["waited"] = round(time.monotonic() - begun, 4)
        head = json.dumps(drawn, separators=(",", ":")).encode()
        body = struct.pack(">I", len(head)) + head + encoded.jpeg
        return Response(body, media_type="application/octet-stream", headers=UNCACHED)

    @app.get("/region")
    async def region(
        payload: float = 0.0, payload_at: float = 0.0, mounting: str = ""
    ) -> JSONResponse:
        """Answer with the outlines of what the tip reaches under a load [px]."""
        try:
            load = Load(payload, payload_at, mounting)
            outlines = await asyncio.to_thread(parts.previewer.region, load)
        except LimbError:
            outlines = []  # the form says what is wrong with the load
        pixels = [parts.overlay.pixels_of(outline) for outline in outlines]
        return JSONResponse(pixels, headers=UNCACHED)


class PageServer:
    """Serves the page from a thread of its own.

    Args:
        binding: where, and with which token.
        parts: what it shows and commands.
        lay_out: adds the layout to the application.

    Raises:
        AccessError: the address is not this machine's, or the port is taken.
    """

    def __init__(
        self, binding: Binding, parts: Parts, lay_out: Callable[[FastAPI, Parts], None]
    ) -> None:
        self._listener: socket.socket = binding.listen()
        port: int = self._listener.getsockname()[1]
        self.url = binding.url(port)
        app = create_app(parts)
        lay_out(app, parts)
        self.access = AccessFilter(app, binding, port)
        self.error: BaseException | None = None
        self._server = uvicorn.Server(
            uvicorn.Config(
                self.access,
                log_level=logging.WARNING,
                access_log=False,
                server_header=False,
                proxy_headers=False,
                ws_ping_interval=1.0,
                ws_ping_timeout=5.0,
                ws_per_message_deflate=False,  # it costs more time than it saves on a local network
                timeout_graceful_shutdown=1,
                lifespan="on",
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
