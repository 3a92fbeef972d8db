"""What a parameter of a limb is declared with, and what follows from the declaration.

A dataclass field carries a `Parameter` in its metadata. From it come the check of the value, the
comment behind the key in a limb file, its row on the site's page and the unknown of the fit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from functools import partial
from typing import Any, get_args, get_origin, get_type_hints

_KEY = "parameter"


class LimbError(ValueError):
    """A limb description is incomplete or impossible; the message says where and why."""


@dataclass(frozen=True)
class Term:
    """The unknown of the fit that stands for a parameter, in units that angles and pressures tell.

    Attributes:
        name: as reports print it.
        unit: of its value.
        scale: a typical value; the solver works in multiples of it.
        low, high: bounds.
        spread: standard deviation before any data; infinite where nothing is known.
        group: the model term that it belongs to; `linear` is always fitted.
        shared: one value for all segments.
        per: powers of other parameters: unknown = parameter · Π other^power. They are declared
            before this parameter.
        relative: the unknown is ln(parameter / prior's), and `per` is not used.
        start: where the search starts if the limb has 0.
        neighbour: place of the segment that it couples to, relative to its own; 0 for none.
        kept: a fit without its group keeps the prior's value; otherwise the term is off.
        per_limit: scale, bounds, spread and start are given for a pressure limit of 1 Pa, and grow
            with this power of a limb's.
    """

    name: str
    unit: str
    scale: float
    low: float
    high: float
    spread: float
    group: str
    shared: bool = False
    per: Mapping[str, int] = field(default_factory=dict)
    relative: bool = False
    start: float = 0.0
    neighbour: int = 0
    kept: bool = False
    per_limit: int = 0

    def at_limit(self, pressure_limit: float) -> Term:
        """Return the term for limbs of a pressure limit [Pa]."""
        unit = pressure_limit**self.per_limit
        keys = ("scale", "low", "high", "spread", "start")
        return replace(self, **{key: unit * getattr(self, key) for key in keys})


@dataclass(frozen=True)
class Parameter:
    """One declared number.

    Attributes:
        unit: SI; "-" for none.
        text: what it is.
        choose: how to find its value.
        low, high: range that a limb file may give.
        low_allowed, high_allowed: whether the ends belong to the range.
        needs: the parameter without which (at 0) this one is not read; where that one is not 0,
            this one may not be 0 either.
        fit: the unknown of the fit; None if the fit keeps the prior's value.
    """

    unit: str
    text: str
    choose: str
    low: float = -math.inf
    high: float = math.inf
    low_allowed: bool = True
    high_allowed: bool = True
    needs: str = ""
    fit: Term | None = None

    @property
    def range(self) -> str:
        """The range in words, with the unit."""
        unit = "" if self.unit == "-" else f" {self.unit}"
        bounds = []
        if math.isfinite(self.low):
            bounds.append(f"{'at least' if self.low_allowed else 'above'} {self.low:g}{unit}")
        if math.isfinite(self.high):
            bounds.append(f"{'at most' if self.high_allowed else 'below'} {self.high:g}{unit}")
        return " and ".join(bounds) or f"finite{', in' + unit if unit else ''}"

    def check(self, value: float, where: str) -> None:
        """Raise a `LimbError` that names ``where``, unit, range and value if out of range."""
        above = value >= self.low if self.low_allowed else value > self.low
        below = value <= self.high if self.high_allowed else value < self.high
        if not (math.isfinite(value) and above and below):
            raise LimbError(f"{where} must be {self.range}, got {value}")


def parameter(
    unit: str,
    text: str,
    choose: str,
    *,
    default: Any = MISSING,
    interval: str = "(-inf, inf)",
    needs: str = "",
    fit: Term | None = None,
) -> Any:
    """Return the field of a dataclass that declares a parameter.

    Args:
        unit: SI; "-" for none.
        text: what it is.
        choose: how to find its value.
        default: of the field; left out: it has none.
        interval: the range, "[0, 1)" where 0 is allowed and 1 is not.
        needs: as `Parameter`.
        fit: the unknown of the fit, if any.
    """
    low, high = map(float, interval[1:-1].split(","))
    ends = interval.startswith("["), interval.endswith("]")
    declared = Parameter(unit, text, choose, low, high, *ends, needs=needs, fit=fit)
    return field(default=default, metadata={_KEY: declared})


positive = partial(parameter, interval="(0, inf)")
"""A parameter that every limb has."""
effect = partial(parameter, default=0.0, interval="[0, inf)")
"""A parameter of something that a limb may show or have; 0: it does not."""
signed_effect = partial(parameter, default=0.0)
"""The same where it has a direction."""


def declarations(kind: Any) -> dict[str, Parameter]:
    """Return the declared parameters of a dataclass by name, in their order."""
    return {item.name: item.metadata[_KEY] for item in fields(kind) if _KEY in item.metadata}


def check(item: Any, where: str = "") -> None:
    """Check every declared parameter of a dataclass instance; ``where`` precedes its name.

    Raises:
        LimbError: a value is out of its range, or 0 where another parameter needs it.
    """
    for name, declared in declarations(item).items():
        value = getattr(item, name)
        if isinstance(value, str):
            value = tuple(map(float, value.split()))
        for number in value if isinstance(value, tuple) else (value,):
            declared.check(number, where + name)
        if value == 0 and declared.needs and getattr(item, declared.needs) != 0:
            raise LimbError(
                f"{where}{name} must be above 0 {declared.unit} where {declared.needs} is not 0, "
                f"got {value}"
            )


def commented(text: str, kind: Any) -> str:
    """Return YAML text in block style with unit and meaning behind each declared key.

    Args:
        text: one mapping, as `read` makes the dataclass of it.
        kind: the dataclass; its fields may be others, or tuples of them.
    """
    sections = {"": declarations(kind)}
    for key, held in get_type_hints(kind).items():
        for each in filter(is_dataclass, (held, *get_args(held))):
            sections[key] = declarations(each)
    section, lines = "", list[str]()
    for line in text.splitlines():
        match = re.match(r"([- ]*)(\w+):", line)
        declared = None
        if match:
            if not match[1]:
                section = match[2]
            declared = sections.get(section if match[1] else "", {}).get(match[2])
        lines.append(f"{line}  # [{declared.unit}] {declared.text}" if declared else line)
    return "\n".join([*lines, ""])


def number(value: object, key: str) -> float:
    """Return a number of a limb file; raise a `LimbError` that names its key if it is none."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        hint = " (YAML reads 1e-3 as text: write 1.0e-3)" if isinstance(value, str) else ""
        raise LimbError(f"{key} must be a number, got {value!r}{hint}")
    return float(value)


def read(kind: Any, content: object, where: str = "") -> Any:
    """Return a dataclass from the mapping of a limb file; fields that it lacks have their defaults.

    Its fields are numbers, texts, free mappings, other such dataclasses, or tuples of these. Keys
    that older files have are in its ``RETIRED``.

    Raises:
        LimbError: no mapping, a key is missing, unknown or of another type; ``where`` is named.
    """
    if not isinstance(content, Mapping):
        raise LimbError(f"{where} must be a mapping of keys, got {content!r}")
    above, known = f"{where}." if where else "", {item.name: item for item in fields(kind)}
    given = {str(key): v for key, v in content.items() if key not in getattr(kind, "RETIRED", ())}
    for key in sorted(given.keys() - known):
        raise LimbError(f"unknown key {above}{key}: the keys here are {', '.join(sorted(known))}")
    for key, item in known.items():
        if key not in given and item.default is MISSING and item.default_factory is MISSING:
            raise LimbError(f"{above}{key} is missing")
    types = get_type_hints(kind)
    return kind(**{key: _value(types[key], value, above + key) for key, value in given.items()})


def _value(kind: Any, value: Any, where: str) -> Any:
    """Return a value of a limb file as a field of this type holds it."""
    if kind is float:
        return number(value, where)
    if kind is str:
        return str(value)
    if is_dataclass(kind):
        return read(kind, {} if value is None else value, where)
    if get_origin(kind) is not tuple:
        return dict(value or {})
    inner, several = get_args(kind)[0], value or ()
    if not isinstance(several, Sequence) or isinstance(several, str):
        what = "numbers" if inner is float else "mappings, one an entry"
        raise LimbError(f"{where} must be a list of {what}, got {value!r}")
    return tuple(_value(inner, item, f"{where}[{index}]") for index, item in enumerate(several))
