"""The page of a limb's parameters, from their declaration."""

from __future__ import annotations

import dataclasses
from typing import Any

from der_planner.limb import (
    CalibratedRange,
    Limb,
    Parameter,
    Pneumatics,
    PointMass,
    Segment,
    Term,
    declarations,
)
from der_planner.results.tables import Table

_HEAD = """\
# The parameters of a limb

All values are SI. A key without a default has to be in the limb file. "Fit" is the unknown by
which the [calibration](../guide/identification.md) finds the value: its unit, its bounds, and ±
the standard deviation of what is known before any data. A relative one is ln(value / the prior's).
Without an entry there, the fit of the bend angles keeps the value; lengths and air have fits of
their own.
"""
_SECTIONS: tuple[tuple[str, Any], ...] = (
    ("`segments`, `pcc_segments`: one entry per segment", Segment),
    ("`pneumatics`", Pneumatics),
    ("The limb itself", Limb),
    ("`masses`: one entry, which may have a `name`, per mass that the limb carries", PointMass),
    ("`calibrated`: one value per segment, and a gravity", CalibratedRange),
)


_HEADER = ("key", "unit", "range", "default", "meaning", "how to choose", "fit")


def page() -> str:
    """Return the page in Markdown."""
    sections = (f"## {title}\n\n{_table(kind).markdown()}" for title, kind in _SECTIONS)
    return "\n".join([_HEAD, *sections])


def _table(kind: Any) -> Table:
    """Return the table of a dataclass's declared parameters."""
    defaults = {item.name: item.default for item in dataclasses.fields(kind)}
    rows = [
        (
            f"`{name}`",
            declared.unit,
            declared.range,
            _default(defaults[name]),
            declared.text + _needs(declared),
            declared.choose,
            _fit(declared.fit),
        )
        for name, declared in declarations(kind).items()
    ]
    return Table(_HEADER, [[cell.replace("|", "\\|") for cell in row] for row in rows])


def _default(value: Any) -> str:
    if value is dataclasses.MISSING:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(list(value))


def _needs(declared: Parameter) -> str:
    return f"; above 0 where `{declared.needs}` is" if declared.needs else ""


def _fit(term: Term | None) -> str:
    if term is None:
        return ""
    name = f"relative, `{term.name}`" if term.relative else f"`{term.name}`"
    unit = "" if term.unit == "-" else f" {term.unit}"
    spread = f", ± {term.spread:g}" if term.spread < float("inf") else ""
    return f"{name} ({term.group}): {term.low:g} to {term.high:g}{unit}{spread}"
