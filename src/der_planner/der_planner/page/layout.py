"""What the page looks like, and what its buttons do."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from fastapi import FastAPI
from nicegui import Client, ui

from der_planner.page.afterwards import listing, replay
from der_planner.page.commands import Answer, Conditions, Service, answer_of
from der_planner.page.drawing.sketch import Sketch
from der_planner.page.motion_form import FormError, MotionForm
from der_planner.page.server import STATIC, Parts
from der_planner.page.setup import page as setup_page

RECONNECT = 3.0
"""[s] that a browser's connection may be away before it counts as lost."""
FAST = 0.3
"""[s] between two looks at who commands."""
SLOW = 2.0
"""[s] between two looks at which plans have been learned."""
LINKS = {
    "Experiments": listing.ADDRESS,
    "Replay": replay.ADDRESS,
    "Set-up guide": setup_page.ADDRESS,
}


def lay_out(app: FastAPI, parts: Parts) -> None:
    """Add the page at `/` to the application."""

    @ui.page("/", title="Limb", favicon="🦑", reconnect_timeout=RECONNECT)
    def index(client: Client) -> None:
        Window(client, parts)

    listing.add_afterwards(parts.experiments)
    replay.add_replay(app, parts)
    setup_page.add_setup(parts)
    ui.run_with(app, show_welcome_message=False, reconnect_timeout=RECONNECT, tailwind=False)


class Window:
    """One browser window: builds its elements and answers its buttons."""

    def __init__(self, client: Client, parts: Parts) -> None:
        self._client = client
        self._parts = parts
        self._name = client.id
        self._guarded: list[ui.element] = []
        ui.add_head_html('<link rel="stylesheet" href="/static/page.css">')
        ui.add_body_html((STATIC / "frame.html").read_text())
        with ui.element("main").props('id="panels"'):
            with self._panel("view", "Camera", "camera", "view.html"):
                self._sketch = Sketch(
                    client, parts, self._conditions, self._may_command, self._tell
                )
            with self._panel("do", "Command", "", ""):
                self._controls()
            self._panel("numbers", "Last 30 s", "driver", "plots.html")
            self._panel("nodes", "Nodes", "", "nodes.html")
        client.on_connect(lambda: parts.desk.connected(self._name, str(client.tab_id)))
        client.on_delete(lambda: parts.desk.disconnected(self._name))
        ui.timer(FAST, self._show_desk)
        ui.timer(SLOW, self._offer_learned)

    def _panel(self, name: str, title: str, source: str, file: str) -> ui.element:
        panel = ui.element("section").props(f'id="{name}" data-source="{source}"')
        with panel:
            ui.html(f"<h2>{title} <span class='age'></span></h2>", sanitize=False)
            if file:
                ui.html((STATIC / file).read_text(), sanitize=False).classes("fill")
        return panel

    # What can be commanded -----------------------------------------------------------------

    def _controls(self) -> None:
        with ui.row().classes("line"):
            self._take = ui.button("Take control", on_click=self._on_take).props('id="take"')
            self._who = ui.label().props('id="who"')
            for text, address in LINKS.items():
                ui.link(text, address, new_tab=True)
        ui.html(
            "<div id='planner-line'></div><div id='plan-line'></div><div id='recorder-line'></div>",
            sanitize=False,
        )
        with ui.row().classes("line"):
            self._button("Arm", "arm", lambda: self._call("arm"), "positive")
            self._button("Stop motion", "stop", lambda: self._call("stop"), "warning")
            self._button("Play last plan again", "start", lambda: self._call("start"), "primary")
        self._form = MotionForm(
            lambda: self._button("Play motion", "play", self._on_play, "primary"),
            self._sketch.look_again,
        )
        with ui.row().classes("line"):
            self._note = ui.input("Note for the recording")
            self._button("Record", "record", self._on_record, "primary")
            self._button("End recording", "unrecord", lambda: self._call("record_stop"), "primary")

    def _button(
        self, text: str, name: str, action: Callable[[], Awaitable[None]], colour: str
    ) -> None:
        button = ui.button(text, on_click=action, color=colour).props(f'id="{name}"')
        self._guarded.append(button)

    def _offer_learned(self) -> None:
        self._form.offer_learned(self._parts.commands.learned_plans())

    def _show_desk(self) -> None:
        desk = self._parts.desk
        mine = desk.may_command(self._name)
        for element in self._guarded:
            element.set_enabled(mine)  # type: ignore[attr-defined]
        self._sketch.play.set_enabled(mine and self._sketch.ready)
        self._take.set_text("Give up control" if mine else "Take control")
        self._take.set_enabled(mine or desk.operator is None)
        if mine:
            self._who.set_text("You command.")
        elif desk.operator is None:
            self._who.set_text("Nobody commands: take control first. Vent always works.")
        else:
            self._who.set_text("Another window commands; you watch. Vent always works.")

    def _on_take(self) -> None:
        desk = self._parts.desk
        if desk.may_command(self._name):
            desk.leave(self._name)
        elif not desk.take(self._name):
            ui.notify("another window commands", type="warning")
        self._show_desk()

    def _may_command(self) -> bool:
        """Tell whether this window commands: a button that is greyed is no protection."""
        if self._parts.desk.may_command(self._name):
            return True
        ui.notify("take control first", type="warning")
        return False

    def _conditions(self) -> Conditions:
        return self._form.conditions()

    async def _call(self, service: Service) -> None:
        if self._may_command():
            self._tell(service, await answer_of(service, self._parts.commands.call(service)))

    async def _on_record(self) -> None:
        if self._may_command():
            pending = self._parts.commands.record(str(self._note.value or ""))
            self._tell("record_start", await answer_of("record_start", pending))

    async def _on_play(self) -> None:
        if not self._may_command():
            return
        try:
            request = self._form.read()
        except FormError as error:
            ui.notify(str(error), type="negative")
            return
        self._tell("play", self._parts.commands.play(request))

    def _tell(self, what: str, answer: Answer) -> None:
        text = f"{what.replace('_', ' ')}: {answer.message}"
        with self._client:
            ui.notify(text, type="positive" if answer.success else "negative", timeout=6000)
