"""The reference pages, written before each build from what the code itself reads."""

from __future__ import annotations

import ast
import dataclasses
import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from der_planner.limb import (
    CalibratedRange,
    Limb,
    Pneumatics,
    PointMass,
    Segment,
    Term,
    declarations,
)
from der_planner.results.tables import Table
from limb_interfaces import topics
from workspace_setup.basics import ROOT

FOLDER = ROOT / "docs" / "generated"
GRAPH = ROOT / "docs" / "reference" / "graph.json"
"""What the running graph says of itself; `documentation.graph` writes it."""
API = {
    "limb": "der_planner.limb der_planner.limb.limb",
    "rod": "der_planner.rod",
    "model": "der_planner.model",
    "planning": "der_planner.planning",
    "control": "der_planner.control",
    "identification": "der_planner.identification",
    "results": "der_planner.results",
    "twin": "der_planner.twin",
    "tracker": "apriltag_tracker.detection apriltag_tracker.pipeline apriltag_tracker.tag_map",
    "driver": "pressure_driver.protocols pressure_driver.settings",
}
"""Pages of the Python interface, and the modules whose public names stand on each."""

LIMB_HEAD = """\
# The parameters of a limb

All values are SI. A key without a default has to be in the limb file. "Fit" is the unknown by
which the [calibration](../guide/identification.md) finds the value: its unit, its bounds, and ±
the standard deviation of what is known before any data. A relative one is ln(value / the prior's).
Without an entry there, the fit of the bend angles keeps the value; lengths and air have fits of
their own.
"""
LIMB_SECTIONS: tuple[tuple[str, Any], ...] = (
    ("`segments`, `pcc_segments`: one entry per segment", Segment),
    ("`pneumatics`", Pneumatics),
    ("The limb itself", Limb),
    ("`masses`: one entry, which may have a `name`, per mass that the limb carries", PointMass),
    ("`calibrated`: one value per segment, and a gravity", CalibratedRange),
)


def write() -> None:
    """Write every generated page."""
    nodes: dict[str, Any] = json.loads(GRAPH.read_text())
    pages = {
        "limb_parameters": limb_page(),
        "node_parameters": node_parameters(nodes),
        "topics": topic_page(nodes),
        "messages": message_page(),
        **{f"api_{name}": api_page(name, modules) for name, modules in API.items()},
    }
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, text in pages.items():
        (FOLDER / f"{name}.md").write_text(text, encoding="utf-8")


def node_parameters(nodes: dict[str, Any]) -> str:
    """Return the page of every node's parameters."""
    parts = [
        "# Parameters of each node\n\nFrom the declarations of the nodes. A bad value ends a node "
        "with a sentence that names it; `ros2 param describe /limb/NODE NAME` tells the same "
        "as here. A default that an experiment sets is left out.\n"
    ]
    for node, found in nodes.items():
        rows = []
        for item in found["parameters"]:
            limits = " to ".join(_number(limit) for limit in item["range"]) or item["choices"]
            shown = item["default"]
            default = "" if shown in ("", []) else f"`{json.dumps(shown)}`"
            text = item["description"] + (" (while it runs, too)" if item["changeable"] else "")
            rows.append((f"`{item['name']}`", default, limits, text))
        parts.append(f"## {node}\n\n{_table(('parameter', 'default', 'allowed', 'meaning'), rows)}")
    return "\n".join(parts)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown; a bar in a cell does not end it."""
    return Table(header, [[cell.replace("|", "\\|") for cell in row] for row in rows]).markdown()


def _number(value: float) -> str:
    return "any" if abs(value) >= 2**62 else f"{value:g}"


def topic_page(nodes: dict[str, Any]) -> str:
    """Return the page of topics and services: their type, who has which end, and what they are."""
    known = dict(topic_texts())
    ends: dict[str, dict[str, Any]] = {}
    for node, found in nodes.items():
        for end in ("publishes", "subscribes"):
            for topic, (kind, quality) in found[end].items():
                entry = ends.setdefault(topic, {"kind": kind, "publishes": [], "subscribes": []})
                entry[end].append(node)
                entry.setdefault("quality", quality)
    rows = [
        (
            f"`{topic}`",
            entry["kind"].replace("/msg/", "/"),
            ", ".join(entry["publishes"]) or "you",
            ", ".join(entry["subscribes"]),
            entry["quality"],
            known.get(topic, ""),
        )
        for topic, entry in sorted(ends.items())
    ]
    services = [
        (f"`{service}`", kind.replace("/srv/", "/"))
        for found in nodes.values()
        for service, kind in found["services"].items()
    ]
    return (
        f"# Topics and services\n\nIn the namespace `/{topics.NAMESPACE}`. The recorder takes "
        "every topic. The types are on the page of [messages](messages.md).\n\n"
        + _table(("topic", "type", "from", "to", "quality", "what"), rows)
        + "\n"
        + _table(("service", "type"), services)
    )


def topic_texts() -> Iterator[tuple[str, str]]:
    """Yield each topic and the text below its name in `limb_interfaces.topics`."""
    body = ast.parse(Path(topics.__file__).read_text(encoding="utf-8")).body
    for name, text in itertools.pairwise(body):
        if isinstance(name, ast.Assign) and isinstance(text, ast.Expr):
            yield ast.literal_eval(name.value), " ".join(ast.literal_eval(text.value).split())


def message_page() -> str:
    """Return the page of the messages and the action, as their files declare them."""
    parts = ["# Messages\n\nOf the package `der_msgs`, all in SI units.\n"]
    for path in sorted((ROOT / "src" / "der_msgs").glob("*/*.[ma][sc][gt]*")):
        parts.append(f"## {path.stem}\n\n```text\n{path.read_text().strip()}\n```\n")
    return "\n".join(parts)


def api_page(name: str, modules: str) -> str:
    """Return the page of one part of the Python interface."""
    blocks = "".join(f"\n.. automodule:: {module}\n" for module in modules.split())
    return f"# {name}\n\n```{{eval-rst}}\n{blocks.strip()}\n```\n"


def limb_page() -> str:
    """Return the page of a limb's parameters, from their declaration."""
    header = ("key", "unit", "range", "default", "meaning", "how to choose", "fit")
    parts = [LIMB_HEAD]
    for title, kind in LIMB_SECTIONS:
        defaults = {item.name: item.default for item in dataclasses.fields(kind)}
        rows = [
            (
                f"`{name}`",
                declared.unit,
                declared.range,
                _default(defaults[name]),
                declared.text + (f"; above 0 where `{declared.needs}` is" * bool(declared.needs)),
                declared.choose,
                _fit(declared.fit),
            )
            for name, declared in declarations(kind).items()
        ]
        parts.append(f"## {title}\n\n{_table(header, rows)}")
    return "\n".join(parts)


def _default(value: Any) -> str:
    if value is dataclasses.MISSING:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(list(value))


def _fit(term: Term | None) -> str:
    if term is None:
        return ""
    term = term.at_limit(Limb.default().pneumatics.pressure_limit)
    name = f"relative, `{term.name}`" if term.relative else f"`{term.name}`"
    unit = "" if term.unit == "-" else f" {term.unit}"
    spread = f", ± {term.spread:g}" if term.spread < float("inf") else ""
    return f"{name} ({term.group}): {term.low:g} to {term.high:g}{unit}{spread}"
