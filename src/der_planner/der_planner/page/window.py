"""The page of one window: what it looks like, its motion form, and what its buttons do."""

from __future__ import annotations

import math
import re
from collections.abc import Awaitable, Callable

from fastapi import FastAPI
from nicegui import Client, ui

from der_msgs.msg import MotionCommand
from der_planner.limb import MOUNTINGS, LimbError, gravity_of
from der_planner.methods import LEARNED
from der_planner.page.commands import Answer, answer_of
from der_planner.page.drawing_panel import DrawingPanel
from der_planner.page.server import STATIC, Parts
from der_planner.page.setup_guide import ADDRESS as SETUP_ADDRESS
from der_planner.page.setup_guide import RECONNECT, add_frame, add_setup_guide, show_answer
from der_planner.page.situation import CENTIMETRES, GRAMS
from der_planner.planning import METHODS
from der_planner.planning.motions import DEFAULT_AMPLITUDE, DEFAULT_CYCLES, DEFAULT_PERIOD, NAMES

PING = 3.0
"""The framework notices a connection that is gone within about this time [s]."""
DESK_INTERVAL = 0.3
"""A window looks who commands at this interval [s]."""
LEARNED_INTERVAL = 2.0
"""A window looks which plans have been learned at this interval [s]."""
NO_PLANS = "No learned plans"
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
"""Such a text is a thousand in one country and one in another."""


def lay_out(app: FastAPI, parts: Parts) -> None:
    """Add the page at `/`, and the set-up guide, to the application."""

    @ui.page("/", title="Limb", favicon="🦑", reconnect_timeout=RECONNECT)
    def index(client: Client) -> None:
        OperatorWindow(client, parts)

    add_setup_guide(parts)
    ui.run_with(app, show_welcome_message=False, reconnect_timeout=PING, tailwind=False)


class OperatorWindow:
    """One browser window: builds its elements and answers its buttons."""

    def __init__(self, client: Client, parts: Parts) -> None:
        self._client = client
        self._parts = parts
        self._buttons: list[ui.button] = []
        ui.add_head_html('<link rel="stylesheet" href="/static/page.css">')
        add_frame(client)
        with ui.element("main").props('id="panels"'):
            with self._panel("view", "Camera", "camera"):
                self._drawing = DrawingPanel(
                    client, parts, self._conditions, self._may_command, self._show
                )
            with self._panel("do", "Command"):
                self._add_controls()
            self._panel("numbers", "Last 30 s", "driver")
            self._panel("nodes", "Nodes")
        ui.timer(DESK_INTERVAL, self._show_desk)
        ui.timer(LEARNED_INTERVAL, lambda: self._form.offer(parts.commands.learned_plans()))

    def _panel(self, name: str, title: str, source: str = "") -> ui.element:
        panel = ui.element("section").props(f'id="{name}" data-source="{source}"')
        content = STATIC / f"{name}.html"
        with panel:
            ui.html(f"<h2>{title} <span class='age'></span></h2>", sanitize=False)
            ui.html(content.read_text(), sanitize=False).classes("fill")
        return panel

    def _add_controls(self) -> None:
        with ui.row().classes("line"):
            self._take = ui.button("Take control", on_click=self._on_take).props('id="take"')
            self._who = ui.label().props('id="who"')
            ui.link("Set-up guide", SETUP_ADDRESS, new_tab=True)
        with ui.row().classes("line"):
            self._add_button("Arm", "arm", lambda: self._call("arm"), "positive")
            self._add_button("Stop motion", "stop", lambda: self._call("stop"), "warning")
            self._add_button("Play last plan again", "start", lambda: self._call("start"))
        self._form = MotionForm(
            lambda: self._add_button("Play motion", "play", self._on_play),
            self._drawing.plan_again,
        )
        with ui.row().classes("line"):
            self._note = ui.input("Note for the recording")
            self._add_button("Record", "record", self._on_record)
            self._add_button("End recording", "unrecord", lambda: self._call("record_stop"))

    def _add_button(
        self, text: str, name: str, action: Callable[[], Awaitable[None]], colour: str = "primary"
    ) -> None:
        button = ui.button(text, on_click=action, color=colour).props(f'id="{name}"')
        self._buttons.append(button)

    def _show_desk(self) -> None:
        desk = self._parts.desk
        mine = desk.may_command(self._client.id)
        for button in self._buttons:
            button.set_enabled(mine)
        self._drawing.play.set_enabled(mine and self._drawing.ready)
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
        if desk.may_command(self._client.id):
            desk.leave(self._client.id)
        elif not desk.take(self._client.id):
            ui.notify("another window commands", type="warning")
        self._show_desk()

    def _may_command(self) -> bool:
        """Tell whether this window commands: a button that is greyed is no protection."""
        if self._parts.desk.may_command(self._client.id):
            return True
        ui.notify("take control first", type="warning")
        return False

    async def _call(self, service: str) -> None:
        if self._may_command():
            answer = await answer_of(service, self._parts.commands.call(service))
            self._show(service.replace("_", " "), answer)

    async def _on_record(self) -> None:
        if self._may_command():
            pending = self._parts.commands.record(str(self._note.value or ""))
            self._show("record", await answer_of("record_start", pending))

    async def _on_play(self) -> None:
        if not self._may_command():
            return
        try:
            command = self._form.command()
        except FormError as error:
            ui.notify(str(error), type="negative")
            return
        self._show("play", await self._parts.commands.play(command))

    def _show(self, what: str, answer: Answer) -> None:
        show_answer(self._client, Answer(answer.success, f"{what}: {answer.message}"))

    def _conditions(self) -> MotionCommand:
        return self._form.conditions()


class FormError(ValueError):
    """What was entered is no motion; the message names the field and what it takes."""


class MotionForm:
    """The fields of a motion command: which motion and model, how far, how fast, what load.

    Args:
        add_play: adds the button that plays the motion, in its place among the fields.
        conditions_changed: is called when `conditions` may return something else.
    """

    def __init__(
        self, add_play: Callable[[], None], conditions_changed: Callable[[], object]
    ) -> None:
        with ui.row().classes("line"):
            self._motion = ui.select(list(NAMES), value=NAMES[0], label="Motion")
            self._model = ui.select(list(METHODS), value="der", label="Model")
            self._model.on_value_change(self._offer_methods)
            self._method = ui.select({}, label="Method")
            self._offer_methods()
        with ui.row().classes("line"):
            degrees = round(math.degrees(DEFAULT_AMPLITUDE), 3)
            self._amplitude = NumberField("Amplitude [°]", degrees, 1, 90)
            self._period = NumberField("Period [s]", DEFAULT_PERIOD, 1, 600)
            self._cycles = NumberField("Cycles", DEFAULT_CYCLES, 1, 100, whole=True)
            add_play()
        with ui.row().classes("line"):
            self._payload = NumberField("Payload [g]", 0, 0, 10_000)
            self._place = NumberField("at [cm], 0: tip", 0, 0, 1000)
            mountings = {"": "planner's", **{name: name for name in MOUNTINGS}}
            self._mounting = ui.select(
                mountings, value="", label="Mounting or tilt [°]", new_value_mode="add-unique"
            ).props('id="mounting"')
        with ui.row().classes("line"):
            self._learned = ui.select([], label=NO_PLANS, clearable=True).props('id="learned"')
            self._feedback = ui.switch("Feedback").props('id="feedback"')
        fields = (self._payload.field, self._place.field, self._model, self._method)
        for element in (*fields, self._mounting, self._feedback):
            element.on_value_change(conditions_changed)

    def command(self) -> MotionCommand:
        """Return the motion that is asked for, or the learned plan where one is chosen.

        Raises:
            FormError: a field holds what it cannot.
        """
        command = self.conditions()
        command.motion = str(self._motion.value)
        command.amplitude = math.radians(self._amplitude.read())
        command.period = self._period.read()
        command.cycles = int(self._cycles.read())
        if self._learned.value:
            command.motion, command.method = str(self._learned.value), LEARNED
        return command

    def conditions(self) -> MotionCommand:
        """Return a command of no motion yet, with what motions and drawings are planned with.

        Raises:
            FormError: a field holds what it cannot.
        """
        return MotionCommand(
            model=str(self._model.value),
            method=str(self._method.value),
            feedback=bool(self._feedback.value),
            payload=self._payload.read() / GRAMS,
            payload_at=self._place.read() / CENTIMETRES,
            mounting=read_mounting(self._mounting.value),
        )

    def offer(self, learned: list[str]) -> None:
        """Offer the plans that are in the planner's folder now; a chosen one that is gone goes."""
        if learned != self._learned.options:
            chosen = self._learned.value if self._learned.value in learned else None
            self._learned.set_options(learned, value=chosen)
            self._learned.props(f'label="{"Learned plan instead" if learned else NO_PLANS}"')

    def _offer_methods(self) -> None:
        names = METHODS[str(self._model.value)]
        self._method.set_options({"": "the best", **{name: name for name in names}}, value="")


class NumberField:
    """A text field for a number; a browser's own field for numbers swallows decimal commas.

    Args:
        label: with the unit.
        value: at first.
        least, most: what it may be.
        whole: whether it must be a whole number.
    """

    def __init__(
        self, label: str, value: float, least: float, most: float, whole: bool = False
    ) -> None:
        self._label, self._least, self._most, self._whole = label, least, most, whole
        self.field = ui.input(label, value=f"{value:g}", validation=self._objection)
        # Telephones show digits, and the space bar vents here, too: no number has a space.
        self.field.props(f"inputmode={'numeric' if whole else 'decimal'} hide-bottom-space")

    def read(self) -> float:
        """Return the number.

        Raises:
            FormError: there is none, or it is out of range.
        """
        try:
            return read_number(self.field.value, self._least, self._most, self._whole)
        except FormError as error:
            text = f"{self._label}: {error}, not '{self.field.value}'"
            raise FormError(text) from error

    def _objection(self, text: object) -> str | None:
        try:
            read_number(text, self._least, self._most, self._whole)
        except FormError as error:
            return str(error)
        return None


def read_number(text: object, least: float, most: float, whole: bool = False) -> float:
    """Return a number as people write it, with a point or a comma before its decimals.

    Raises:
        FormError: it is none, not from ``least`` to ``most``, or not a whole one.
    """
    given = str(text or "").strip()
    if _THOUSANDS.fullmatch(given):
        raise FormError("a point before decimals, and no mark of thousands")
    try:
        value = float(given.replace(",", ".").replace("_", "?"))
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise FormError(f"a number from {least:g} to {most:g}")
    if whole and value != round(value):
        raise FormError("a whole number")
    return value


def read_mounting(given: object) -> str:
    """Return a mounting as a motion command has it: a name, degrees, or nothing for the planner's.

    Raises:
        FormError: it is neither.
    """
    text = str(given or "").strip().removesuffix("°").strip().replace(",", ".")
    try:
        if text:
            gravity_of(text)
    except LimbError as error:
        raise FormError(str(error)) from error
    return text
