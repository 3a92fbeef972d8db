"""The page of one window: what it looks like, and what its buttons do."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from typing import Any

from fastapi import FastAPI
from nicegui import Client, ui

from der_msgs.msg import MotionCommand
from der_planner.page.commands import Answer
from der_planner.page.drawing_panel import DrawingPanel
from der_planner.page.forms import FormError, MotionForm
from der_planner.page.server import STATIC, Parts
from der_planner.page.setup_guide import ADDRESS as SETUP_ADDRESS
from der_planner.page.setup_guide import RECONNECT, add_frame, add_setup_guide, show_answer
from der_planner.page.situation import SILENT

PING = 3.0
"""The framework notices a connection that is gone within about this time [s]."""
DESK_INTERVAL = 0.3
"""A window looks who commands, and what can be done, at this interval [s]."""
LEARNED_INTERVAL = 2.0
"""A window looks which plans have been learned at this interval [s]."""
MOTION, LEARNED_PLAN, DRAWING, AGAIN = "motion", "learned", "drawing", "again"
SOURCES = {
    MOTION: "Named motion", LEARNED_PLAN: "Learned plan", DRAWING: "Drawing", AGAIN: "Last plan",
}  # fmt: skip
"""What the one play button plays."""
OBSTACLES = {
    "disarmed": "the limb is disarmed: arm first",
    "fault": "the driver is in fault: remove the cause, then arm",
    SILENT: "the driver is not heard any more",
}
"""Why nothing is played in a mode of the driver."""
CURVES = {
    "pressure": ("Differential pressure", "kPa", ("measured", "commanded")),
    "bend": ("Bend angle", "°", ("measured",)),
    "error": ("Tip error", "cm", ()),
}
"""The curves: title, unit, and what there is for each segment; nothing: one curve of the tip."""
COLOURS = ("#2367c9", "#d2601a", "#3c8a3c", "#8a3c8a")
"""Of the segments."""


def lay_out(app: FastAPI, parts: Parts) -> None:
    """Add the page at `/`, and the set-up guide, to the application."""

    @ui.page("/", title=parts.situation.namespace, favicon="🦑", reconnect_timeout=RECONNECT)
    def index(client: Client) -> None:
        OperatorWindow(client, parts)

    add_setup_guide(parts)
    ui.run_with(app, show_welcome_message=False, reconnect_timeout=PING, tailwind=False)


class OperatorWindow:
    """One browser window: builds its elements and answers its buttons."""

    def __init__(self, client: Client, parts: Parts) -> None:
        self._client = client
        self._parts = parts
        self._buttons: dict[str, tuple[ui.element, ui.button]] = {}
        self._reasons: dict[str, str] = {}
        ui.add_head_html('<link rel="stylesheet" href="/static/page.css">')
        add_frame(client)
        with ui.element("div").props('id="panels"'):
            with ui.element("section").props('id="act"'):
                self._add_desk()
            with self._panel("view", "Camera", "camera"):
                self._drawing = DrawingPanel(client, parts, self._conditions, self._on_drawing)
            with self._panel("do", "Command"):
                self._add_controls()
            with self._panel("numbers", "Last 30 s", "driver"):
                add_curves(parts.previewer.limb.segment_count)
            self._panel("nodes", "Nodes")
        self._show_desk()
        ui.timer(DESK_INTERVAL, self._show_desk)
        ui.timer(LEARNED_INTERVAL, lambda: self._form.offer(parts.commands.learned_plans()))

    def _panel(self, name: str, title: str, source: str = "") -> ui.element:
        panel = ui.element("section").props(f'id="{name}" data-source="{source}"')
        content = STATIC / f"{name}.html"
        with panel:
            ui.html(f"<h2>{title} <span class='age'></span></h2>", sanitize=False)
            ui.html(content.read_text(), sanitize=False).classes("fill")
        return panel

    def _add_desk(self) -> None:
        with ui.row().classes("line"):
            self._take = ui.button("Take control", on_click=self._on_take).props('id="take"')
            self._add_button("Arm", "arm", lambda: self._call("arm"), "positive")
            self._add_button("Stop motion", "stop", lambda: self._call("stop"), "warning")
            ui.link("Set-up guide", SETUP_ADDRESS, new_tab=True)
            self._who = ui.label().props('id="who" role="status"')

    def _add_controls(self) -> None:
        with ui.row().classes("line"):
            self._source = ui.toggle(SOURCES, value=MOTION).props('id="source" dense')
            self._add_button("Play", "play", self._on_play)
        self._why = ui.label().props('id="why"')
        self._form = MotionForm(self._drawing.plan_again)
        with ui.row().classes("line"):
            self._note = ui.input("Note for the recording")
            self._add_button("Record", "record", self._on_record)
            self._add_button("End recording", "unrecord", lambda: self._call("record_stop"))

    def _add_button(
        self, text: str, name: str, action: Callable[[], Awaitable[None]], colour: str = "primary"
    ) -> None:
        # A disabled button tells nothing to a pointer: what is around it does.
        with ui.element("span") as around:
            button = ui.button(text, on_click=action, color=colour).props(f'id="{name}"')
        self._buttons[name] = around, button

    def _on_drawing(self) -> None:
        """Choose a drawing as soon as it can be played."""
        if self._drawing.ready:
            self._source.set_value(DRAWING)
        self._show_desk()

    def _obstacle(self, name: str) -> str:
        """Return why a button can do nothing now; empty if it can."""
        if not self._parts.desk.may_command(self._client.id):
            return "take control first"
        mode = self._parts.situation.driver_mode
        concerned = name == "play" or (name == "arm" and mode == SILENT)
        if concerned and mode in OBSTACLES:
            return OBSTACLES[mode]
        if name != "play":
            return ""
        if self._source.value == DRAWING and not self._drawing.ready:
            return "draw on the picture first, and wait for the preview"
        if self._source.value == LEARNED_PLAN and not self._form.learned:
            return "choose a learned plan first"
        return ""

    def _show_desk(self) -> None:
        desk, limb = self._parts.desk, self._parts.situation.namespace
        mine = desk.may_command(self._client.id)
        for name, (around, button) in self._buttons.items():
            reason = self._obstacle(name)
            if self._reasons.get(name) != reason:
                self._reasons[name] = reason
                button.set_enabled(not reason)
                around.props(f'title="{reason}"')
        reason = self._obstacle("play")
        self._why.set_text(f"Play: {reason}." if reason and mine else "")
        self._take.set_text("Give up control" if mine else "Take control")
        self._take.set_enabled(mine or desk.operator is None)
        if mine:
            self._who.set_text(f"You command {limb}.")
        elif desk.operator is None:
            self._who.set_text(f"Nobody commands {limb}: take control first. Vent always works.")
        else:
            self._who.set_text(f"Another window commands {limb}; you watch. Vent always works.")

    def _on_take(self) -> None:
        desk = self._parts.desk
        if desk.may_command(self._client.id):
            desk.leave(self._client.id)
        elif not desk.take(self._client.id):
            ui.notify("another window commands", type="warning")
        self._show_desk()

    def _may_do(self, name: str) -> bool:
        """Tell whether a button can act now: one that is greyed is no protection."""
        if reason := self._obstacle(name):
            ui.notify(reason, type="warning")
        return not reason

    async def _call(self, service: str) -> None:
        if self._may_do(service):
            self._show(service.replace("_", " "), await self._parts.commands.call(service))

    async def _on_record(self) -> None:
        if self._may_do("record"):
            self._show("record", await self._parts.commands.record(str(self._note.value or "")))

    async def _on_play(self) -> None:
        if not self._may_do("play"):
            return
        if self._source.value == AGAIN:
            self._show("play", await self._parts.commands.call("start"))
            return
        try:
            if self._source.value == DRAWING:
                command = self._drawing.command()
            else:
                command = self._form.command(learned=self._source.value == LEARNED_PLAN)
        except FormError as error:
            ui.notify(str(error), type="negative")
            return
        self._show("play", await self._parts.commands.play(command))

    def _show(self, what: str, answer: Answer) -> None:
        show_answer(self._client, Answer(answer.success, f"{what}: {answer.message}"))

    def _conditions(self) -> MotionCommand:
        return self._form.conditions()


def add_curves(segments: int) -> None:
    """Add the curves of the last 30 s, which `plots.js` fills; each by its name."""
    numbers = {}
    for name, (title, unit, kinds) in CURVES.items():
        series: list[dict[str, Any]] = [
            {
                "name": f"segment {segment} {kind}", "type": "line", "showSymbol": False,
                "color": COLOURS[segment % len(COLOURS)],
                "lineStyle": {"type": "dotted" if kind == "commanded" else "solid"},
            }
            for kind in kinds
            for segment in range(segments)
        ]  # fmt: skip
        tip = {"name": "tip", "type": "line", "showSymbol": False, "color": COLOURS[0]}
        rows = 2 if len(kinds) > 1 else 1  # of the legend
        chart = ui.echart(
            {
                "animation": False,
                "title": {
                    "text": f"{title} [{unit}]", "left": 0, "top": 6, "padding": 0,
                    "textStyle": {"fontSize": 12},
                },
                "legend": {
                    "top": 24, "left": 0, "padding": 0, "itemHeight": 8, "itemWidth": 18,
                    "itemGap": 6, "textStyle": {"fontSize": 10},
                },
                "grid": {"left": 36, "right": 14, "top": 28 + 14 * rows, "bottom": 20},
                "xAxis": {"type": "value", "min": -30, "max": 0, "name": "s", "nameGap": 4},
                # Noise of a limb at rest is not drawn as if it were motion.
                "yAxis": {"type": "value", "splitNumber": 3, "minInterval": 1 if kinds else 0.1},
                "tooltip": {"trigger": "axis"},
                "dataZoom": [{"type": "inside"}],
                "series": series or [tip],
            }
        )  # fmt: skip
        numbers[name] = chart.classes("curve").id
    ui.add_body_html(f"<script>page.curves = {json.dumps(numbers)};</script>")
