"""Measure time and memory of one part or all, beside a peer where there is one.

python3 scripts/benchmark.py rod
python3 scripts/benchmark.py all --json figures.json
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import re
import time
from pathlib import Path

from der_planner.experiment.console import OptionError, check_file

PARTS = {
    "rod": "rod",
    "planning": "planning",
    "driver": "driver",
    "tracker": "tracker.limb",
    "recorder": "recorder",
    "identification": "identification",
    "studies": "studies",
    "feedback": "feedback",
    "page": "page",
}
"""Module of each part, below `benchmarks`; its ``run(quick)`` prints and returns the figures."""


def machine() -> dict[str, str | int]:
    """Describe the machine that the figures belong to."""
    model = re.search(r"model name\s*: (.+)", Path("/proc/cpuinfo").read_text())
    return {
        "processor": model[1] if model else platform.processor(),
        "cores": os.cpu_count() or 0,
        "system": platform.platform(),
        "python": platform.python_version(),
        "date": time.strftime("%Y-%m-%d"),
        "load_average_1min": f"{os.getloadavg()[0]:.2f}",
    }


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument(
        "parts",
        nargs="+",
        choices=(*PARTS, "all"),
        metavar="PART",
        help=f"of {', '.join(PARTS)}; or all",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every figure here, too")
    parser.add_argument("--quick", action="store_true", help="fewer sizes and repetitions")
    options = parser.parse_args()
    if options.json is not None:
        try:
            check_file(options.json, "--json")
        except OptionError as error:
            parser.error(str(error))
        options.json.parent.mkdir(parents=True, exist_ok=True)
    parts = list(PARTS) if "all" in options.parts else options.parts
    where = machine()
    print(", ".join(f"{key} {value}" for key, value in where.items()))
    figures: dict[str, object] = {"machine": where}
    for part in parts:
        print(f"\n== {part}", flush=True)
        figures[part] = importlib.import_module(f"benchmarks.{PARTS[part]}").run(options.quick)
        if options.json is not None:
            options.json.write_text(json.dumps(figures, indent=1))
    return 0
