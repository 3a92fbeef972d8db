"""Write the driver's parameter files and its page's table from their declaration.

python3 scripts/write_driver_parameters.py
"""

from __future__ import annotations

from typing import Any

from pressure_driver.settings import NODES, Settings, declarations
from workspace_setup.basics import ROOT

PACKAGE = ROOT / "src" / "pressure_driver"
BEGIN, END = "<!-- parameters: begin -->\n", "<!-- parameters: end -->\n"
"""Around the table in the page."""


def parameter_file(node: str) -> str:
    """Return the text of a node's parameter file, which holds the defaults."""
    lines = [
        f"# Parameters of {node}, their defaults; written by scripts/write_driver_parameters.py.",
        f"# `ros2 param describe /limb/{node} NAME` tells the range of each.",
        f"/**/{node}:",
        "  ros__parameters:",
    ]
    for name, declaration, default in declarations(NODES[node]):
        lines.append(f"    # {declaration.description}")
        lines.append(f"    {name}: {_written(default)}")
    return "\n".join(lines) + "\n"


def table() -> str:
    """Return the page's table of the driver's parameters."""
    lines = ["| parameter | default | range | meaning |", "|---|---|---|---|"]
    for name, declaration, default in declarations(Settings):
        limits = ", ".join(declaration.choices)
        if declaration.range is not None:
            limits = " to ".join(f"{limit:,g}".replace(",", " ") for limit in declaration.range)
        shown = f"{_written(default)} {declaration.unit}".strip()
        lines.append(f"| `{name}` | {shown} | {limits} | {declaration.text} |")
    return "\n".join(lines) + "\n"


def with_table(readme: str) -> str:
    """Return the text of the page with its table as it should be."""
    before, _, rest = readme.partition(BEGIN)
    return before + BEGIN + table() + END + rest.partition(END)[2]


def _written(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return value or '""' if isinstance(value, str) else str(value)


def main() -> int:
    """Write the files of the package."""
    for node in NODES:
        (PACKAGE / "config" / f"{node}.yaml").write_text(parameter_file(node), encoding="utf-8")
    readme = ROOT / "docs" / "guide" / "driver.md"
    readme.write_text(with_table(readme.read_text(encoding="utf-8")), encoding="utf-8")
    return 0
