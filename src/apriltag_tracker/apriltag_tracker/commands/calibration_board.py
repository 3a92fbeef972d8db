"""The calibration board on the command line: the same options print it and find it."""

from __future__ import annotations

import argparse

from apriltag_tracker.sheets import BoardLayout


def add_board_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the measures of the board."""
    default = BoardLayout()
    parser.add_argument("--columns", type=int, default=default.columns)
    parser.add_argument("--rows", type=int, default=default.rows)
    parser.add_argument("--square", type=float, default=default.square, help="edge in m")
    parser.add_argument("--marker", type=float, default=default.marker, help="edge in m")


def given_board(options: argparse.Namespace) -> BoardLayout:
    """Return the board that the options describe."""
    return BoardLayout(options.columns, options.rows, options.square, options.marker)
