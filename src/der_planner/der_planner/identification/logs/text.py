"""Tables of numbers as text files of any program: separators, decimal commas, encodings."""

from __future__ import annotations

import codecs
import csv
import math
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from der_planner.identification.logs.log import LogError

Array = NDArray[np.float64]

SEPARATORS = "\t;,"
"""Of columns; a table has the first of these that its header holds."""
_FORGIVING = "cp1252"
"""What is no UTF-8 is read so: names of columns may hold a degree sign of an older program."""


def read_table(path: Path) -> dict[str, Array]:
    """Return the columns (K,) of a table by the names in its header; missing numbers are NaN.

    Lines before the header that begin with ``#`` and empty lines are skipped, and a last row that
    ends early, as that of a program that was killed, is left out. Numbers may have a decimal comma
    where columns are separated by something else, or in quotes.

    Raises:
        LogError: the file cannot be read, names a column twice, has fewer than two rows or another
            number of columns in a row, or holds something that is no number; names line and column.
    """
    lines = _lines(path)
    if not lines:
        raise LogError(f"the log {path} is empty")
    separator = next((mark for mark in SEPARATORS if mark in lines[0][1]), ",")
    rows = list(csv.reader((text for _, text in lines), delimiter=separator))
    header = [name.strip() for name in rows[0]]
    twice = [name for name, count in Counter(header).items() if name and count > 1]
    if twice:
        raise LogError(f"the log {path} has two columns '{twice[0]}': name them differently")
    if len(rows) > 1 and len(rows[-1]) < len(header):
        rows.pop()
    if len(rows) < 3:
        raise LogError(f"the log {path} has fewer than two rows below its header")
    values = np.empty((len(rows) - 1, len(header)))
    for index, row in enumerate(rows[1:]):
        number = lines[index + 1][0]
        if len(row) != len(header):
            raise LogError(
                f"line {number} of {path} has {len(row)} columns, its header has {len(header)}"
            )
        for place, cell in enumerate(row):
            values[index, place] = _number(
                cell, f"line {number}, column '{header[place]}' of {path}"
            )
    return {name: values[:, index] for index, name in enumerate(header)}


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return the lines that hold something, with their numbers from 1; the first is the header."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise LogError(f"cannot read the log {path}: {error.strerror}") from error
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        text = content.decode("utf-16", errors="replace")
    else:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode(_FORGIVING, errors="replace")
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    while lines and lines[0][1].lstrip().startswith("#"):
        lines.pop(0)
    return lines


def _number(cell: str, where: str) -> float:
    text = cell.strip()
    if not text:
        return math.nan
    try:
        value = float(text if "," not in text else text.replace(",", "."))
    except ValueError as error:
        raise LogError(
            f"{where} is '{text}', which is no number: leave cells without a value empty, or write "
            "NaN"
        ) from error
    return value if math.isfinite(value) else math.nan
