"""The set-up guide: a checklist for the first power-up, each line checked while one looks."""

from __future__ import annotations

import asyncio
import functools

from nicegui import Client, ui

from der_planner.limb import Limb
from der_planner.page.commands import FILLING, Answer, answer_of
from der_planner.page.server import STATIC, Parts
from der_planner.page.setup.steps import FILLED, SetupGuide, chamber
from der_planner.page.situation import PASCAL_PER_KILOPASCAL

ADDRESS = "/setup"
INTERVAL = 0.5
"""[s] between two looks."""


def add_setup(parts: Parts) -> None:
    """Add the page at `ADDRESS`."""

    @ui.page(ADDRESS, title="Limb: set-up", favicon="🦑")
    def guide(client: Client) -> None:
        ui.add_head_html('<link rel="stylesheet" href="/static/page.css">')
        ui.add_body_html((STATIC / "frame.html").read_text())
        steps = SetupGuide(parts.studio.limb.segment_count, Limb.default().name)
        with ui.element("main").props('id="setup"'):
            ui.html("<h2>First power-up</h2>", sanitize=False)
            ui.label("From top to bottom; every line is checked twice a second.")
            lines = ui.column().classes("fill")
            _add_buttons(client, parts)
        client.on_delete(lambda: parts.desk.disconnected(client.id))

        def look() -> None:
            calibrated, problem = parts.overlay.camera()
            found = steps.steps(parts.situation.snapshot(), problem, calibrated)
            lines.clear()
            with lines:
                for number, step in enumerate(found, 1):
                    with ui.element("div").classes("step done" if step.done else "step"):
                        ui.label(f"{'✔' if step.done else '○'} {number}. {step.title}")
                        ui.label(step.seen if step.done else f"{step.seen}. {step.advice}")

        look()
        ui.timer(INTERVAL, look)


def _add_buttons(client: Client, parts: Parts) -> None:
    """Add the buttons that arm and fill one chamber; each commands only as long as it acts."""
    limit = parts.studio.limb.pneumatics.pressure_limit
    pressure = min(FILLED * PASCAL_PER_KILOPASCAL, limit)

    def tell(answer: Answer) -> None:
        with client:
            ui.notify(
                answer.message,
                type="positive" if answer.success else "negative",
                timeout=6000,
            )

    def may_command() -> bool:
        if parts.desk.take(client.id):
            return True
        tell(Answer(False, "another window commands: give up control there first"))
        return False

    async def arm() -> None:
        if may_command():
            try:
                tell(await answer_of("arm", parts.commands.call("arm")))
            finally:
                parts.desk.leave(client.id)

    async def fill(segment: int, side: int) -> None:
        if may_command():
            try:
                tell(parts.commands.fill(segment, side, pressure))
                await asyncio.sleep(FILLING)
            finally:
                parts.desk.leave(client.id)

    ui.label(f"One chamber alone, {pressure / PASCAL_PER_KILOPASCAL:.0f} kPa for {FILLING:.0f} s:")
    with ui.row().classes("line"):
        ui.button("Arm", on_click=arm, color="positive").props('id="arm"')
        for segment in range(parts.studio.limb.segment_count):
            for side in (1, -1):
                press = functools.partial(fill, segment, side)
                name = f"fill-{segment}-{'left' if side > 0 else 'right'}"
                text = chamber(segment, side).partition(" (")[0]
                ui.button(f"Fill {text}", on_click=press).props(f'id="{name}"')
