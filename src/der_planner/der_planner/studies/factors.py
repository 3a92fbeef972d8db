"""The factors that a study may vary, each declared once: unit, meaning, range or names, default.

A new factor is one entry of `FACTORS`, and one place in a task that reads it: tasks get a row's
values with every default filled in.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from der_planner.limb import MOUNTINGS, LimbError, Pneumatics, Segment, declarations, gravity_of
from der_planner.planning import METHODS
from der_planner.planning.motions import DEFAULT_AMPLITUDE, DEFAULT_CYCLES, DEFAULT_PERIOD, NAMES

Value = float | int | str
RUN, MODEL, IDENTIFICATION = "run", "model", "identification"
PLANNED = (RUN, MODEL)
TWIN = (RUN, IDENTIFICATION)
EVERY = (RUN, MODEL, IDENTIFICATION)
ERROR = "error."
"""How the name of the error of a limb parameter begins."""


class StudyError(RuntimeError):
    """A study cannot be read, played or kept; the message names the thing and the remedy."""


@dataclass(frozen=True)
class Factor:
    """One thing that a study may vary.

    Attributes:
        unit: "-" for none.
        text: what it is.
        tasks: that read it.
        default: for rows that do not name it; also tells the kind: a float for numbers, an int for
            whole numbers, a str for names.
        low, high: range of a number.
        choices: names to choose of.
        degrees: whether an angle may stand in place of a name, as that of a mounting.
    """

    unit: str
    text: str
    tasks: tuple[str, ...]
    default: Value
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    degrees: bool = False

    @property
    def range(self) -> str:
        """What may be given, in words."""
        if self.choices:
            angle = ", or degrees by which its plane is tilted about the straight limb"
            return f"one of {', '.join(self.choices)}{angle if self.degrees else ''}"
        kind = "a whole number" if isinstance(self.default, int) else "a number"
        return f"{kind} from {self.low:g} to {self.high:g}"

    def checked(self, value: object, where: str) -> Value:
        """Return a value as the kind that it is.

        Raises:
            StudyError: it is of another kind or out of range; names ``where``.
        """
        if self.choices:
            if isinstance(value, bool):  # so YAML reads yes and no, on and off
                said = {True: ("yes", "on"), False: ("no", "off")}[value]
                value = next((name for name in said if name in self.choices), value)
            if value in self.choices:
                return str(value)
            if self.degrees and not isinstance(value, bool):
                with contextlib.suppress(LimbError):
                    gravity_of(str(value))
                    return str(value)
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            whole = isinstance(self.default, int)
            inside = math.isfinite(value) and self.low <= value <= self.high
            if inside and (not whole or value == int(value)):
                return int(value) if whole else float(value)
        raise StudyError(f"{where} must be {self.range}, got {value!r}")


def _choice(
    text: str, tasks: tuple[str, ...], choices: tuple[str, ...], degrees: bool = False
) -> Factor:
    """Return a factor that has a name for a value; the first one is the default."""
    return Factor("-", text, tasks, choices[0], choices=choices, degrees=degrees)


FACTORS: dict[str, Factor] = {
    "seed": Factor("-", "draws the twin's hardware", TWIN, 1, 0, 2**31 - 1000),
    "motion": Factor("-", "named motion", PLANNED, "same_direction", choices=NAMES),
    "model": _choice("planned with", PLANNED, tuple(METHODS)),
    "method": _choice(
        "of planning, the same for both models; best: optimal", PLANNED, ("best", *METHODS["der"])
    ),
    "amplitude": Factor("rad", "largest bend of a segment", PLANNED, DEFAULT_AMPLITUDE, 0.01, 2.0),
    "period": Factor("s", "of one cycle", PLANNED, DEFAULT_PERIOD, 0.5, 600.0),
    "cycles": Factor("-", "of the motion", PLANNED, DEFAULT_CYCLES, 1, 1000),
    "calibration": _choice(
        "run that the twin is calibrated with: 90 s, 200 s, or none (the default limb is used)",
        TWIN,
        ("quick", "long", "none"),
    ),
    "tag_noise": Factor(
        "-",
        "noise of tags and board, calibrating and in feedback, as a multiple of the usual one",
        TWIN,
        1.0,
        0.0,
        100.0,
    ),
    "mounting": _choice(
        "how the limb is mounted, when it is calibrated and when it plays",
        EVERY,
        tuple(MOUNTINGS),
        degrees=True,
    ),
    "payload": Factor("kg", "carried while it plays, not when calibrated", PLANNED, 0.0, 0.0, 10.0),
    "payload_at": Factor(
        "m", "where along the limb, from the clamp; 0: at the tip", PLANNED, 0.0, 0.0, 10.0
    ),
    "learning_runs": Factor(
        "-", "earlier runs of the motion that the plan has learned from (der)", (RUN,), 0, 0, 100
    ),
    "feedback": _choice("whether commands are revised while the limb moves", (RUN,), ("off", "on")),
    "latency": Factor(
        "s", "from a picture to what was seen on it, for feedback", (RUN,), 0.07, 0.0, 2.0
    ),
    "payload_known": _choice("whether the plan reckons with the payload", PLANNED, ("yes", "no")),
}
_NOT_VARIED = ("pressure_limit", "slew_limit")
"""Limits are not errors of a model."""


def limb_parameters() -> dict[str, str]:
    """Return what each parameter is that ``error.NAME`` may change."""
    return {
        name: declared.text
        for kind in (Segment, Pneumatics)
        for name, declared in declarations(kind).items()
        if name not in _NOT_VARIED
    }


def split_error(name: str) -> tuple[str, int | None]:
    """Return the parameter and the segment of ``error.PARAMETER`` or ``error.PARAMETER[i]``.

    Raises:
        StudyError: the limb has no such parameter, or it does not belong to a segment.
    """
    match = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", name.removeprefix(ERROR))
    known = limb_parameters()
    if match is None or match[1] not in known:
        raise StudyError(f"factors.{name}: no such parameter of a limb; known: {', '.join(known)}")
    segment = None if match[2] is None else int(match[2])
    if segment is not None and match[1] not in declarations(Segment):
        raise StudyError(f"factors.{name}: {match[1]} is one for the limb: leave [{segment}] away")
    return match[1], segment


def factor(name: str, task: str) -> Factor:
    """Return the factor of a name.

    Raises:
        StudyError: there is none, or the task does not read it; lists those that it does.
    """
    if name.startswith(ERROR) and task in PLANNED:
        parameter, segment = split_error(name)
        place = "" if segment is None else f" of segment {segment}"
        text = f"relative error of {parameter}{place}: {limb_parameters()[parameter]}"
        return Factor("-", text, PLANNED, 0.0, -0.99, 100.0)
    known = of_task(task)
    if name not in known:
        several = [*known, f"{ERROR}PARAMETER"] if task in PLANNED else list(known)
        reason = "is not read by" if name in FACTORS or name.startswith(ERROR) else "is unknown to"
        raise StudyError(f"factors.{name} {reason} task '{task}'; known: {', '.join(several)}")
    return known[name]


def of_task(task: str) -> dict[str, Factor]:
    """Return the factors that a task reads."""
    return {name: each for name, each in FACTORS.items() if task in each.tasks}


def with_defaults(row: Mapping[str, Value], task: str) -> dict[str, Any]:
    """Return a row with the default of every factor that it does not name."""
    return {name: each.default for name, each in of_task(task).items()} | dict(row)
