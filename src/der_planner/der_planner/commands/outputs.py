"""Whether a result can be written where it is wanted: known before hours of work, not after."""

from __future__ import annotations

import os
from pathlib import Path


class OutputError(RuntimeError):
    """A result cannot be written there; the message names the path and why."""


def check_file(path: Path, option: str = "--out") -> None:
    """Refuse a path at which no file can be written; nothing is left behind.

    Raises:
        OutputError: it is a folder, or its folder cannot be made or written.
    """
    if path.is_dir():
        raise OutputError(f"{option} {path} is a folder: name a file")
    if path.exists():
        if not os.access(path, os.W_OK):
            raise OutputError(f"{option} {path} cannot be written: no right to")
        return
    check_folder(path.parent, option)


def check_folder(path: Path, option: str = "--out") -> None:
    """Refuse a path at which no folder can be made or written; nothing is left behind.

    Raises:
        OutputError: a file is in the way, or the user has no right to write there.
    """
    present = path.absolute()
    while not present.exists() and present != present.parent:
        present = present.parent
    if not present.is_dir():
        raise OutputError(f"{option} {path} cannot be made: {present} is no folder")
    if not os.access(present, os.W_OK | os.X_OK):
        raise OutputError(f"{option} {path} cannot be written: no right to write in {present}")
