"""Repair bags that a kill, a crash or a full disk left without their index.

python3 scripts/recover_bag.py out/bags/same_direction_der_1

The files are repaired in place: whole chunks stay as they are, what was half written behind the
last one is cut, index and metadata.yaml are added. A bag that is whole is left alone.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from der_planner.bags.recover import Recovery, recover_bag
from der_planner.bags.scan import RecoverError


def _show(fraction: float) -> None:
    if sys.stderr.isatty():
        print(f"\r  {fraction:4.0%}", end="", file=sys.stderr, flush=True)


def describe(report: Recovery) -> str:
    """Return a sentence on what was found and done."""
    held = f"{report.message_count} messages over {report.duration:.1f} s"
    if not report.repaired and not report.wrote_metadata:
        return f"{report.path}: whole, nothing to repair ({held})"
    done = [f"index of {name} added" for name in report.repaired]
    if report.wrote_metadata:
        done.append("metadata.yaml written")
    if report.lost_bytes:
        done.append(f"{report.lost_bytes} bytes of an unfinished record cut")
    if report.damaged_chunks:
        done.append(f"{report.damaged_chunks} damaged chunks left out of the index")
    return f"{report.path}: {', '.join(done)}; holds {held}"


def main() -> int:
    """Run the command line; 0 when every bag is whole now, 1 otherwise."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="folder or .mcap file")
    failed = 0
    for path in parser.parse_args().bags:
        try:
            report = recover_bag(path, _show)
        except (RecoverError, OSError) as error:
            print(f"error: {error}", file=sys.stderr)
            failed += 1
            continue
        print(("\r" if sys.stderr.isatty() else "") + describe(report))
    return 1 if failed else 0
