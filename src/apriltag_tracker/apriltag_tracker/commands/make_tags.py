"""Print sheets in true size: the tags of a tag map, or a board to calibrate the camera with.

python3 scripts/make_tags.py tags --out sheets/
python3 scripts/make_tags.py board --paper letter --out sheets/
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from apriltag_tracker.installed import CONFIG
from apriltag_tracker.sheets import (
    PAPERS,
    Page,
    SheetError,
    add_board_arguments,
    board_page,
    given_board,
    tag_pages,
    write_pdf,
)
from apriltag_tracker.tag_map import MapError, TagMap


def _write(pages: list[Page], name: str, options: argparse.Namespace) -> None:
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / f"{name}.pdf"
    write_pdf(pages, path)
    print(path)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    what = parser.add_subparsers(dest="what", required=True)
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--paper", choices=sorted(PAPERS), default="a4")
    common.add_argument("--out", type=Path, default=Path("sheets"), metavar="DIR")
    tags = what.add_parser("tags", parents=[common], help="every tag of a tag map")
    tags.add_argument("--tag-map", type=Path, default=CONFIG / "tags.yaml", metavar="FILE")
    add_board_arguments(what.add_parser("board", parents=[common], help="a calibration board"))
    options = parser.parse_args()
    try:
        if options.what == "tags":
            _write(tag_pages(TagMap.from_yaml(options.tag_map), options.paper), "tags", options)
        else:
            _write([board_page(given_board(options), options.paper)], "board", options)
    except (MapError, SheetError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print("Print at 100 % (no 'fit to page') and check the 100 mm line with a ruler.")
    return 0
