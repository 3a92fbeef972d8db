"""Whether a result can be written where it is wanted: known before hours of work, not after."""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path


class OutputError(RuntimeError):
    """A result cannot be written there; the message names the path and why."""


def check_file(path: Path, option: str = "--out") -> None:
    """Refuse a path at which no file can be written; nothing is left behind.

    Raises:
        OutputError: it is a folder, or its folder cannot be made or written.
    """
    try:
        if path.is_dir():
            raise OutputError(f"{option} {path} is a folder: name a file")
        if path.exists():
            path.open("ab").close()
            return
    except OSError as error:
        raise OutputError(f"{option} {path} cannot be written: {error.strerror}") from error
    _try_folder(Path(os.path.realpath(path)).parent, f"{option} {path}")


def check_folder(path: Path, option: str = "--out") -> None:
    """Refuse a path at which no folder can be made or written; nothing is left behind.

    Raises:
        OutputError: a file is in the way, or no file can be made there.
    """
    _try_folder(path.absolute(), f"{option} {path}")


def _try_folder(path: Path, named: str) -> None:
    """Make a file in a folder, or in what is there of it, and remove it again."""
    present = path
    try:
        while not present.exists() and present != present.parent:
            present = present.parent
        if not present.is_dir():
            raise OutputError(f"{named} cannot be made: {present} is no folder")
        with tempfile.TemporaryFile(dir=present):
            pass  # as root, and on read-only disks, only a trial tells
    except OSError as error:
        raise OutputError(f"{named} cannot be written: {error.strerror} in {present}") from error


def folder_argument(text: str) -> Path:
    """Return a folder of the command line that can be written; for the ``type`` of argparse.

    Raises:
        argparse.ArgumentTypeError: it cannot.
    """
    try:
        check_folder(Path(text), "the folder")
    except OutputError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return Path(text)
