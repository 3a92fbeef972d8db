"""The page that replays a bag with a time slider; nothing on it but the bar below is live."""

from __future__ import annotations

import asyncio
from concurrent.futures import CancelledError, Future
from urllib.parse import quote

from fastapi import FastAPI, Response
from fastapi.responses import PlainTextResponse
from nicegui import ui

from der_planner.bags.reader import BagError
from der_planner.page.afterwards.playback import describe, frame, settle
from der_planner.page.server import STATIC, Parts

ADDRESS = "/replay"
_UNCACHED = {"Cache-Control": "no-store"}


def replay_address(bag: str) -> str:
    """Return where the page replays a bag."""
    return f"{ADDRESS}?bag={quote(bag, safe='')}"


def add_replay(app: FastAPI, parts: Parts) -> None:
    """Add the page at `ADDRESS` and what its window fetches."""
    add_data(app, parts)

    @ui.page(ADDRESS, title="REPLAY", favicon="⏪")
    def replay(bag: str = "") -> None:
        parts.replayer.ask(settle)  # its process starts while somebody chooses
        ui.add_head_html('<link rel="stylesheet" href="/static/page.css">')
        ui.add_body_html((STATIC / "frame.html").read_text())
        ui.add_body_html('<script src="/static/replay.js"></script>')
        with ui.element("main").props('id="replay"'):
            ui.html((STATIC / "replay.html").read_text(), sanitize=False).classes("fill")
            with ui.element("section").props('id="choose"'):
                _choose(parts, bag)


def _choose(parts: Parts, bag: str) -> None:
    """Add what chooses a bag: one of the experiments', or any by its path."""

    def go(path: str) -> None:
        if path.strip():
            ui.navigate.to(replay_address(path.strip()))

    ui.html("<h2>Choose a recording</h2>", sanitize=False)
    known = parts.experiments.recordings()
    last = parts.situation.value_of("recorder", "bag")
    if last and last not in known:
        known = {last: f"the recorder's newest: {last}", **known}
    with ui.row().classes("line"):
        chosen = ui.select(
            known, label="Of the experiments and the recorder", value=bag if bag in known else None
        ).props('id="choose-bag"')
        chosen.on_value_change(lambda event: go(str(event.value or "")))
    with ui.row().classes("line"):
        path = ui.input("Any bag: its path on the page's computer", value=bag)
        path.props('id="bag-path"').on("keydown.enter", lambda: go(str(path.value or "")))
        ui.button("Open", on_click=lambda: go(str(path.value or ""))).props('id="open-bag"')


def add_data(app: FastAPI, parts: Parts) -> None:
    """Add the addresses from which a window fetches a bag's curves and its frames."""

    @app.get(f"{ADDRESS}/data")
    async def data(bag: str) -> Response:
        return await _answer(parts.replayer.ask(describe, bag), "application/json")

    @app.get(f"{ADDRESS}/frame")
    async def one_frame(bag: str, at: float) -> Response:
        return await _answer(parts.replayer.ask(frame, bag, at), "application/octet-stream")


async def _answer(pending: Future[bytes], media_type: str) -> Response:
    try:
        found = await asyncio.wrap_future(pending)
    except BagError as error:
        return PlainTextResponse(str(error), status_code=422, headers=_UNCACHED)
    except (CancelledError, asyncio.CancelledError):
        return PlainTextResponse("the page is closing", status_code=503, headers=_UNCACHED)
    except Exception as error:  # the worker may be gone; whoever looks must read it
        text = f"the bag cannot be shown: {error or type(error).__name__}"
        return PlainTextResponse(text, status_code=500, headers=_UNCACHED)
    return Response(found, media_type=media_type, headers=_UNCACHED)
