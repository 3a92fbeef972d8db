"""Save what can be read of bags that a kill, a crash, a full or a damaged disk left.

python3 scripts/recover_bag.py out/bags/same_direction_der_1
python3 scripts/recover_bag.py run.mcap --out saved/run

The bag itself stays as it is: its whole messages go into a new bag, BAG_recovered or that of --out.
For a bag that is whole nothing is written, unless --out names where.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from der_planner.bags.recover import RecoverError, Recovery, recover_bag


def describe(found: Recovery) -> str:
    """Return a sentence on what was found and done."""
    held = f"{found.source}: {found.message_count} messages"
    if found.folder is None:
        return f"{held}, whole, nothing to recover"
    text = f"{held} saved in {found.folder}; lost: {found.lost_bytes} bytes"
    return text + f", {found.unnamed} messages whose topic nothing tells" * bool(found.unnamed)


def main() -> int:
    """Run the command line; 0 when something was saved of every bag, 1 otherwise."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="folder or .mcap file")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="the new bag, for one BAG")
    options = parser.parse_args()
    if options.out is not None and len(options.bags) > 1:
        parser.error("--out names one new bag: give one BAG")
    failed = 0
    for path in options.bags:
        try:
            print(describe(recover_bag(path, options.out)))
        except (RecoverError, OSError) as error:
            print(f"error: {error}", file=sys.stderr)
            failed += 1
    return 1 if failed else 0
