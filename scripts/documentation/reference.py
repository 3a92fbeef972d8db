"""The reference pages, written before each build from what the code itself reads."""

from __future__ import annotations

import ast
import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from documentation import limb_page
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


def write() -> None:
    """Write every generated page."""
    nodes: dict[str, Any] = json.loads(GRAPH.read_text())
    pages = {
        "limb_parameters": limb_page.page(),
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
        rows = ["| parameter | default | allowed | meaning |", "|---|---|---|---|"]
        for item in found["parameters"]:
            limits = " to ".join(_number(limit) for limit in item["range"]) or item["choices"]
            shown = item["default"]
            default = "" if shown in ("", []) else f"`{json.dumps(shown)}`"
            text = item["description"] + (" (while it runs, too)" if item["changeable"] else "")
            cells = (f"`{item['name']}`", default, limits, text)
            rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        parts.append(f"## {node}\n\n" + "\n".join(rows) + "\n")
    return "\n".join(parts)


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
    head = "| topic | type | from | to | quality | what |"
    rows = [head, "|---|---|---|---|---|---|"]
    for topic, entry in sorted(ends.items()):
        cells = (
            f"`{topic}`",
            entry["kind"].replace("/msg/", "/"),
            ", ".join(entry["publishes"]) or "you",
            ", ".join(entry["subscribes"]),
            entry["quality"],
            known.get(topic, ""),
        )
        rows.append("| " + " | ".join(cells) + " |")
    services = [
        f"| `{service}` | {kind.replace('/srv/', '/')} |"
        for found in nodes.values()
        for service, kind in found["services"].items()
    ]
    return (
        f"# Topics and services\n\nIn the namespace `/{topics.NAMESPACE}`. The recorder takes "
        "every topic. The types are on the page of [messages](messages.md).\n\n"
        + "\n".join(rows)
        + "\n\n| service | type |\n|---|---|\n"
        + "\n".join(services)
        + "\n"
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
