"""The fields of a motion command, and numbers and mountings as people write them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

from nicegui import ui

from der_msgs.msg import MotionCommand
from der_planner.limb import MOUNTINGS, LimbError, gravity_of
from der_planner.methods import LEARNED
from der_planner.page.situation import CENTIMETRES, GRAMS
from der_planner.planning import METHODS
from der_planner.planning.motions import DEFAULT_AMPLITUDE, DEFAULT_CYCLES, DEFAULT_PERIOD, NAMES

NO_PLANS = "No learned plans"
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
"""Such a text is a thousand in one country and one in another."""


class FormError(ValueError):
    """What was entered is no motion; the message names the field and what it takes."""


class MotionForm:
    """The fields of a motion command: which motion and model, how far, how fast, what load.

    Args:
        conditions_changed: is called when `conditions` may return something else.
    """

    def __init__(self, conditions_changed: Callable[[], object]) -> None:
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

    @property
    def learned(self) -> str:
        """Name of the learned plan that is chosen; empty: none."""
        return str(self._learned.value or "")

    def command(self, learned: bool) -> MotionCommand:
        """Return the motion that is asked for, or the learned plan in place of it.

        Raises:
            FormError: a field holds what it cannot.
        """
        command = self.conditions()
        command.motion = str(self._motion.value)
        command.amplitude = math.radians(self._amplitude.read())
        command.period = self._period.read()
        command.cycles = int(self._cycles.read())
        if learned:
            command.motion, command.method = self.learned, LEARNED
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
            self._learned.props(f'label="{"Learned plan" if learned else NO_PLANS}"')

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
