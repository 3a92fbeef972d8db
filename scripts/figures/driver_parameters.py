"""Write the driver's parameter files from their declaration.

python3 scripts/write_driver_parameters.py
"""

from __future__ import annotations

import argparse
from typing import Any

from pressure_driver.settings import NODES, declarations
from workspace_setup.basics import ROOT

PACKAGE = ROOT / "src" / "pressure_driver"


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


def _written(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return value or '""' if isinstance(value, str) else str(value)


def main() -> int:
    """Write the files of the package."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    for node in NODES:
        (PACKAGE / "config" / f"{node}.yaml").write_text(parameter_file(node), encoding="utf-8")
    return 0
