"""The panel by which a window draws a path on the picture, looks at it, and plays it."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from typing import Any

import numpy as np
from nicegui import Client, ui
from nicegui.events import GenericEventArguments
from numpy.typing import NDArray

from der_planner.page.commands import Answer, Conditions
from der_planner.page.drawing.kept import DrawingError
from der_planner.page.drawing.preview import Preview
from der_planner.page.drawing.studio import drawn_pixels
from der_planner.page.server import Parts
from der_planner.page.situation import centimetres

PIECES = 30
"""Points of a predicted limb's line."""
FOLLOWED = 1e-3
"""[m] A drawing counts as followed as it is if the limb stays this near to it."""


class Sketch:
    """A window's drawing: its points, its preview, and the buttons below the picture.

    Args:
        client: the window.
        parts: what the page shows and commands.
        conditions: returns what to plan with; raises `ValueError` where it makes no sense.
        may_command: tells whether this window commands, and says so if not.
        tell: shows an answer.
    """

    def __init__(
        self,
        client: Client,
        parts: Parts,
        conditions: Callable[[], Conditions],
        may_command: Callable[[], bool],
        tell: Callable[[str, Answer], None],
    ) -> None:
        self._client, self._parts = client, parts
        self._conditions, self._may_command, self._tell = conditions, may_command, tell
        self._drawn: NDArray[np.float64] | None = None
        """What was drawn last, whether it can be played or not."""
        self._planned: tuple[NDArray[np.float64], Conditions] | None = None
        """What can be played, and what it was planned with."""
        self._pending: Future[Preview] | None = None
        with ui.row().classes("line"):
            self._switch = ui.switch("Draw on the picture", on_change=self._on_switch)
            self._switch.props('id="draw"')
            ui.button("Clear", on_click=self._clear).props('id="clear" flat')
            self.play = ui.button("Play drawing", on_click=self._on_play).props('id="play-drawing"')
        with ui.row().classes("line"):
            self._kept = ui.select(parts.studio.drawings.names(), label="Kept drawings")
            ui.button("Show", on_click=self._on_load).props('id="load-drawing" flat')
            self._title = ui.input("Name of the drawing").classes("drawing-name")
            ui.button("Keep", on_click=self._on_save).props('id="save-drawing" flat')
        self._result = ui.label().props('id="preview"')
        ui.on("drawn", self._on_drawn)

    @property
    def ready(self) -> bool:
        """Whether there is a drawing that can be played."""
        return self._planned is not None and self._pending is None and bool(self._switch.value)

    def _run(self, script: str) -> None:
        self._client.run_javascript(script)

    def _on_switch(self) -> None:
        if self._switch.value:
            self._shade()  # before the window asks for what is reachable
        self._run(f"page.sketch.turn({json.dumps(bool(self._switch.value))})")
        if not self._switch.value:
            self._clear()

    def _clear(self) -> None:
        self._drawn = self._planned = None
        if self._pending is not None:
            self._pending.cancel()
            self._pending = None
        self._result.set_text("")
        self._run("page.sketch.clear()")

    async def _on_drawn(self, event: GenericEventArguments) -> None:
        sent = event.args.get("points") if isinstance(event.args, dict) else None
        try:
            tip = self._parts.overlay.on_plane(drawn_pixels(sent))
        except DrawingError as error:
            self._result.set_text(str(error))
            return
        if tip is None:
            self._result.set_text("The camera's pose is not known yet: are the fixed tags seen?")
            return
        await self._look_at(tip)

    async def look_again(self) -> None:
        """Shade and plan anew: what they reckon with may have changed."""
        if self._switch.value:
            self._shade()
            if self._drawn is not None:
                await self._look_at(self._drawn)

    def _shade(self) -> None:
        """Let the window ask for what is reachable under the load of the form."""
        with contextlib.suppress(ValueError):  # the form says it, and a drawing's preview does
            load = json.dumps(dataclasses.asdict(self._conditions().load))
            self._run(f"page.sketch.carry({load})")

    async def _look_at(self, tip: NDArray[np.float64]) -> None:
        """Plan a drawing beside the page and show what comes of it."""
        if self._pending is not None:
            self._pending.cancel()
            self._pending = None
        self._drawn, self._planned = tip, None
        self.play.set_enabled(False)
        try:
            conditions = self._conditions()
            limb = self._parts.studio.limb_under(conditions.load)
        except ValueError as error:
            self._result.set_text(f"This cannot be planned: {error}")
            return
        self._result.set_text("Planning what the limb can follow …")
        pending = self._pending = self._parts.studio.previewer.ask(
            limb, tip, conditions.model, conditions.method
        )
        try:
            found = await asyncio.wrap_future(pending)
        except (CancelledError, asyncio.CancelledError):
            return
        except Exception as error:  # the worker may be gone; the operator must read it
            found = Preview(
                np.empty((0, 2)), problem=f"no preview: {error or type(error).__name__}"
            )
        if self._pending is not pending:
            return
        self._pending = None
        if not found.problem:
            self._planned = tip, conditions
        self._result.set_text(summary(found))
        place = self._parts.overlay.pixels_of
        thinned = [pose[:: max(1, len(pose) // PIECES)] for pose in found.poses]
        shown: dict[str, Any] = {
            "drawn": place(tip),
            "path": place(found.path),
            "poses": [place(pose) for pose in thinned],
            "duration": found.duration,
        }
        self._run(f"page.sketch.show({json.dumps(shown, separators=(',', ':'))})")

    def _on_play(self) -> None:
        if not self._may_command():
            return
        if self._planned is None:
            ui.notify("draw a line first, and wait for its preview", type="warning")
            return
        self._tell("play drawing", self._parts.commands.play_path(*self._planned))

    async def _on_load(self) -> None:
        if not self._kept.value:
            ui.notify("choose a drawing first", type="warning")
            return
        try:
            tip = self._parts.studio.drawings.load(str(self._kept.value))
        except DrawingError as error:
            ui.notify(str(error), type="negative")
            return
        self._switch.set_value(True)
        await self._look_at(tip)

    def _on_save(self) -> None:
        if self._drawn is None:
            ui.notify("there is no drawing to keep", type="warning")
            return
        drawings = self._parts.studio.drawings
        try:
            name = drawings.save(str(self._title.value or ""), self._drawn)
        except DrawingError as error:
            ui.notify(str(error), type="negative")
            return
        self._kept.set_options(drawings.names(), value=name)
        ui.notify(f"kept as {drawings.folder / name}.csv", type="positive")


def summary(found: Preview) -> str:
    """Return what a preview says, in a few sentences."""
    if found.problem:
        return f"This cannot be played: {found.problem}"
    followed = "The limb follows this drawing"
    if found.deviation_largest >= FOLLOWED:
        followed = (
            "This drawing leaves what the limb reaches. The dashed line is the nearest path that "
            f"it can follow, {found.deviation_mean * 100:.1f} cm away on average, "
            f"{found.deviation_largest * 100:.1f} cm at most. It is followed"
        )
    text = (
        f"{followed} in {found.duration:.1f} s, with {found.largest_pressure / 1000:.1f} kPa at "
        f"most; predicted error {centimetres(found.predicted_error)}."
    )
    return " ".join([text, *(f"Warning: {warning}." for warning in found.warnings)])
