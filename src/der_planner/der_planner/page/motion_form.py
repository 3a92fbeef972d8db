"""The form of a motion command: which motion, with which model, how far, how fast, what load."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace

from nicegui import ui

from der_planner.limb import MOUNTINGS, LimbError, gravity_of
from der_planner.methods import LEARNED
from der_planner.page.commands import Conditions, Load, MotionRequest
from der_planner.planning import METHODS
from der_planner.planning.motions import DEFAULT_AMPLITUDE, DEFAULT_CYCLES, DEFAULT_PERIOD, NAMES

NO_PLANS = "No learned plans"
BEST = "the best"
GRAMS, CENTIMETRES = 1000.0, 100.0
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
"""What is a thousand in one country and one in another."""


class FormError(ValueError):
    """What was entered is no motion; the message names the field and what it takes."""


def read_number(text: object, least: float, most: float) -> float:
    """Return a number as people write it, with a point or a comma before its decimals.

    Raises:
        FormError: it is none, or not from ``least`` to ``most``.
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
    return value


class Quantity:
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
        self._field = ui.input(label, value=f"{value:g}", validation=self._objection)
        # Telephones show digits, and the space bar vents here, too: no number has a space.
        self._field.props(f"inputmode={'numeric' if whole else 'decimal'} hide-bottom-space")

    def on_change(self, action: Callable[[], object]) -> None:
        """Call something whenever the text changes."""
        self._field.on_value_change(action)

    def read(self) -> float:
        """Return the number.

        Raises:
            FormError: there is none, or it is out of range.
        """
        objection = self._objection(self._field.value)
        if objection:
            raise FormError(f"{self._label}: {objection}, not '{self._field.value}'")
        return read_number(self._field.value, self._least, self._most)

    def _objection(self, text: object) -> str | None:
        try:
            value = read_number(text, self._least, self._most)
        except FormError as error:
            return str(error)
        if self._whole and value != round(value):
            return "a whole number"
        return None


class MotionForm:
    """The fields of a window; `read` makes a request of them.

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
            self._method = ui.select({"": BEST}, value="", label="Method")
            self._offer_methods()
        with ui.row().classes("line"):
            degrees = round(math.degrees(DEFAULT_AMPLITUDE), 3)
            self._amplitude = Quantity("Amplitude [°]", degrees, 1, 90)
            self._period = Quantity("Period [s]", DEFAULT_PERIOD, 1, 600)
            self._cycles = Quantity("Cycles", DEFAULT_CYCLES, 1, 100, whole=True)
            add_play()
        with ui.row().classes("line"):
            self._payload = Quantity("Payload [g]", 0, 0, 10_000)
            self._place = Quantity("at [cm], 0: tip", 0, 0, 1000)
            mountings = {"": "planner's", **{name: name for name in MOUNTINGS}}
            self._mounting = ui.select(
                mountings, value="", label="Mounting or tilt [°]", new_value_mode="add-unique"
            ).props('id="mounting"')
        with ui.row().classes("line"):
            self._learned = ui.select([], label=NO_PLANS, clearable=True).props('id="learned"')
            self._feedback = ui.switch("Feedback").props('id="feedback"')
        for quantity in (self._payload, self._place):
            quantity.on_change(conditions_changed)
        for choice in (self._model, self._method, self._mounting, self._feedback):
            choice.on_value_change(conditions_changed)

    def read(self) -> MotionRequest:
        """Return what is asked for.

        Raises:
            FormError: a field holds what it cannot.
        """
        request = MotionRequest(
            motion=str(self._motion.value),
            amplitude=math.radians(self._amplitude.read()),
            period=self._period.read(),
            cycles=int(self._cycles.read()),
            conditions=self.conditions(),
        )
        learned = str(self._learned.value or "")
        if not learned:
            return request
        conditions = replace(request.conditions, method=LEARNED)
        return replace(request, motion=learned, conditions=conditions)

    def conditions(self) -> Conditions:
        """Return what motions and drawings are to be planned with.

        Raises:
            FormError: a field holds what it cannot.
        """
        load = Load(
            self._payload.read() / GRAMS,
            self._place.read() / CENTIMETRES,
            read_mounting(self._mounting.value),
        )
        return Conditions(
            str(self._model.value), str(self._method.value), load, bool(self._feedback.value)
        )

    def offer_learned(self, names: list[str]) -> None:
        """Offer the plans that are in the planner's folder now; a chosen one that is gone goes."""
        if names == self._learned.options:
            return
        chosen = self._learned.value if self._learned.value in names else None
        self._learned.set_options(names, value=chosen)
        label = "Learned plan instead" if names else NO_PLANS
        self._learned.props(f'label="{label}"')

    def _offer_methods(self) -> None:
        names = METHODS[str(self._model.value)]
        self._method.set_options({"": BEST, **{name: name for name in names}}, value="")


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
