"""The fields below the picture by which a window draws a path, previews, keeps and plays it."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Callable
from concurrent.futures import CancelledError, Future

import numpy as np
from geometry_msgs.msg import Point
from nicegui import Client, ui
from nicegui.events import GenericEventArguments

from der_msgs.msg import MotionCommand
from der_planner.arrays import Array
from der_planner.limb import Load
from der_planner.page.drawing import DrawingError, Preview, drawn_pixels
from der_planner.page.server import Parts
from der_planner.page.situation import centimetres

CURVE_POINTS = 30
"""A pose of the predicted limb is shown with about this many points."""


class DrawingPanel:
    """A window's drawing: its points, its preview, and the buttons below the picture.

    Args:
        client: the window.
        parts: what the page shows and commands.
        conditions: returns a command with what to plan with; raises `ValueError` where that makes
            no sense.
        on_change: is called when there is a drawing that can be played, or none any more.
    """

    def __init__(
        self,
        client: Client,
        parts: Parts,
        conditions: Callable[[], MotionCommand],
        on_change: Callable[[], None],
    ) -> None:
        self._client, self._parts = client, parts
        self._conditions, self._on_change = conditions, on_change
        self._drawn: Array | None = None
        """What was drawn last (P, 2) [m], whether it can be played or not."""
        self._playable: MotionCommand | None = None
        """The command that plays the drawing with what it was previewed with."""
        self._pending: Future[Preview] | None = None
        with ui.row().classes("line"):
            self._switch = ui.switch("Draw on the picture", on_change=self._on_switch)
            self._switch.props('id="draw"')
            ui.button("Clear", on_click=self._clear).props('id="clear" flat')
        with ui.row().classes("line"):
            self._kept = ui.select(parts.drawings.names(), label="Kept drawings")
            ui.button("Show", on_click=self._on_load).props('id="load-drawing" flat')
            self._title = ui.input("Name of the drawing").classes("drawing-name")
            ui.button("Keep", on_click=self._on_save).props('id="save-drawing" flat')
        self._result = ui.label().props('id="preview" role="status"')
        ui.on("drawn", self._on_drawn)

    @property
    def ready(self) -> bool:
        """Whether there is a drawing that can be played."""
        return self._playable is not None and bool(self._switch.value)

    def _run(self, function: str, *arguments: object) -> None:
        """Call a function of drawing.js in the window."""
        given = ", ".join(json.dumps(each, separators=(",", ":")) for each in arguments)
        self._client.run_javascript(f"page.drawing.{function}({given})")

    def _on_switch(self) -> None:
        if self._switch.value:
            self._shade_region()  # before the window asks for what is reachable
        self._run("turn", bool(self._switch.value))
        if not self._switch.value:
            self._clear()

    def _clear(self) -> None:
        self._forget_preview()
        self._drawn = None
        self._result.set_text("")
        self._run("clear")

    def _forget_preview(self) -> None:
        self._playable = None
        if self._pending is not None:
            self._pending.cancel()
            self._pending = None
        self._on_change()

    async def _on_drawn(self, event: GenericEventArguments) -> None:
        sent = event.args.get("points") if isinstance(event.args, dict) else None
        try:
            tip = self._parts.overlay.on_plane(drawn_pixels(sent))
            if tip is None:
                raise DrawingError("the camera's pose is not known yet: are the fixed tags seen?")
        except DrawingError as error:
            self._clear()  # the window shows the drawing before it no more
            self._result.set_text(str(error))
            return
        await self._plan(tip)

    async def plan_again(self) -> None:
        """Shade and plan anew: what they reckon with may have changed."""
        if self._switch.value:
            self._shade_region()
            if self._drawn is not None:
                await self._plan(self._drawn)

    def _shade_region(self) -> None:
        """Let the window ask for what is reachable under the load of the form."""
        with contextlib.suppress(ValueError):  # the form says it, and a drawing's preview does
            self._run("setLoad", _load_of(self._conditions())._asdict())

    async def _plan(self, tip: Array) -> None:
        """Plan a drawing (P, 2) [m] beside the page and show what comes of it."""
        self._forget_preview()
        self._drawn = tip
        previewer = self._parts.previewer
        try:
            command = self._conditions()
            limb = previewer.limb_under(_load_of(command))
        except ValueError as error:
            self._result.set_text(f"This cannot be planned: {error}")
            return
        self._result.set_text("Planning what the limb can follow …")
        pending = self._pending = previewer.ask(limb, tip, command.model, command.method)
        try:
            found = await asyncio.wrap_future(pending)
        except (CancelledError, asyncio.CancelledError):
            return
        except Exception as error:  # the process may be gone; the operator must read it
            problem = f"no preview: {error or type(error).__name__}"
            found = Preview(np.empty((0, 2)), problem=problem)
        if self._pending is not pending:
            return
        self._pending = None
        if not found.problem:
            command.path = [Point(x=float(x), y=float(y)) for x, y in tip]
            command.nearest_path = True
            self._playable = command
            self._on_change()
        self._result.set_text(summary(found))
        self._show_preview(tip, found)

    def _show_preview(self, tip: Array, found: Preview) -> None:
        pixels_of = self._parts.overlay.pixels_of
        thinned = [pose[:: max(1, len(pose) // CURVE_POINTS)] for pose in found.poses]
        preview = {
            "drawn": pixels_of(tip),
            "path": pixels_of(found.path),
            "poses": [pixels_of(pose) for pose in thinned],
            "duration": found.duration,
            "place": pixels_of(np.array(found.place).reshape(-1, 2)) if found.place else [],
        }
        self._run("show", preview)

    def command(self) -> MotionCommand:
        """Return what plays the drawing, with what it was previewed with; only while `ready`."""
        assert self._playable is not None
        return self._playable

    async def _on_load(self) -> None:
        if not self._kept.value:
            ui.notify("choose a drawing first", type="warning")
            return
        try:
            tip = self._parts.drawings.load(str(self._kept.value))
        except DrawingError as error:
            ui.notify(str(error), type="negative")
            return
        self._switch.set_value(True)
        await self._plan(tip)

    def _on_save(self) -> None:
        if self._drawn is None:
            ui.notify("there is no drawing to keep", type="warning")
            return
        try:
            file = self._parts.drawings.save(str(self._title.value or ""), self._drawn)
        except DrawingError as error:
            ui.notify(str(error), type="negative")
            return
        self._kept.set_options(self._parts.drawings.names(), value=file.stem)
        ui.notify(f"kept as {file}", type="positive")


def _load_of(command: MotionCommand) -> Load:
    return Load(command.payload, command.payload_at, command.mounting)


def summary(found: Preview) -> str:
    """Return what a preview says, in a few sentences."""
    if found.problem:
        return f"This cannot be played: {found.problem}"
    followed = "The limb follows this drawing"
    if found.deviation:
        followed = (
            f"This drawing leaves what the limb reaches: {found.deviation}. The dashed line, the "
            "nearest path, is followed"
        )
    text = (
        f"{followed} in {found.duration:.1f} s, with {found.largest_pressure / 1000:.1f} kPa at "
        f"most; predicted error {centimetres(found.predicted_error)}."
    )
    return " ".join([text, *(f"Warning: {warning}." for warning in found.warnings)])
