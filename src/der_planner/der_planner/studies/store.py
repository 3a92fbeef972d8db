"""The rows of a study on disk: a small Parquet file for each task, whole or not there.

A file is written beside its place and moved there, so a killed process leaves no half of one, and
it carries the key of its first row as its name, so no row is there twice.
"""

from __future__ import annotations

import errno
import io
import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from der_planner.studies.cache import write_whole
from der_planner.studies.factors import StudyError
from der_planner.studies.study import Row, Study

Kept = dict[str, Any]
"""A row as it is kept: key, factors, results, error and sources by column."""


class Outcome(NamedTuple):
    """What became of one row: results by column, empty after an error; kind and message of it."""

    results: dict[str, float]
    error: str = ""


class Store:
    """The folder of a study: ``study.yaml``, ``rows/*.parquet``, ``times.csv``.

    Args:
        folder: made if missing.
        study: whose rows are kept.

    Raises:
        StudyError: the folder cannot be written, or holds a study of another task.
    """

    def __init__(self, folder: Path, study: Study) -> None:
        self.folder, self._study = folder, study
        self._rows = folder / "rows"
        self.unreadable = 0
        """Files that were not whole when they were read: their rows are done again."""
        self._schema = _schema(study)
        try:
            self._rows.mkdir(parents=True, exist_ok=True)
            self._claim()
        except OSError as error:
            raise _unwritable(folder, error) from error

    def _claim(self) -> None:
        about = self.folder / "study.json"
        mine = {"task": self._study.task.name, "name": self._study.name}
        if about.exists():
            theirs = json.loads(about.read_text(encoding="utf-8"))
            if theirs.get("task") != mine["task"]:
                raise StudyError(
                    f"{self.folder} holds the study {theirs.get('name')} of task "
                    f"'{theirs.get('task')}', not of '{mine['task']}': choose another --out"
                )
        write_whole(about, json.dumps(mine, indent=1).encode())
        write_whole(self.folder / "study.yaml", self._study.text.encode())

    def keep(self, rows: Sequence[Row], outcomes: Sequence[Outcome], sources: str) -> None:
        """Write finished rows, whole or not at all.

        Raises:
            StudyError: the disk is full, or the folder cannot be written any more.
        """
        records: list[Kept] = []
        for row, outcome in zip(rows, outcomes, strict=True):
            results = {name: outcome.results.get(name) for name in self._study.keep}
            error = outcome.error or None
            records.append(
                {"key": row.key, **row.values, **results, "error": error, "sources": sources}
            )
        self._write(pa.Table.from_pylist(records, schema=self._schema), rows[0].key)

    def _write(self, table: Any, key: str) -> None:
        buffer = io.BytesIO()
        pyarrow.parquet.write_table(table, buffer)
        try:
            write_whole(self._rows / f"{key}.parquet", buffer.getvalue())
        except OSError as error:
            raise _unwritable(self._rows, error) from error

    def forget(self, keys: Collection[str]) -> None:
        """Take rows that are to be done again out of the files, so that none is there twice.

        Raises:
            StudyError: the folder cannot be written.
        """
        for path in sorted(self._rows.glob("*.parquet")):
            table = pyarrow.parquet.read_table(path)
            stay = [place for place, key in enumerate(table["key"].to_pylist()) if key not in keys]
            if len(stay) == table.num_rows:
                continue
            if stay:
                self._write(table.take(stay), table["key"][stay[0]].as_py())
            if not stay or table["key"][stay[0]].as_py() != path.stem:
                path.unlink()

    def note(self, line: str) -> None:
        """Append a line on what a task took to ``times.csv``, which no result depends on."""
        try:
            with (self.folder / "times.csv").open("a", encoding="utf-8") as file:
                file.write(f"{line}\n")
        except OSError as error:
            raise _unwritable(self.folder, error) from error

    def load(self) -> dict[str, Kept]:
        """Return the rows of the study that are done, by key, in the order of the table.

        A file that is not whole, as after a loss of power, is removed. A row that was kept without
        a column that the study now asks for counts as not done.
        """
        found: dict[str, Kept] = {}
        for path in sorted(self._rows.glob("*.parquet")):
            try:
                table = pyarrow.parquet.read_table(path)
            except (pa.ArrowInvalid, OSError):
                self.unreadable += 1
                path.unlink(missing_ok=True)
                continue
            if set(self._study.keep) <= set(table.column_names):
                found |= {record["key"]: record for record in table.to_pylist()}
        return {row.key: found[row.key] for row in self._study.rows if row.key in found}

    def write_table(self, kept: Mapping[str, Kept]) -> Path:
        """Write all rows as one table, ``rows.csv``, in the order of the study; return its path."""
        path = self.folder / "rows.csv"
        buffer = io.BytesIO()
        pyarrow.csv.write_csv(pa.Table.from_pylist(list(kept.values()), self._schema), buffer)
        try:
            write_whole(path, buffer.getvalue())
        except OSError as error:
            raise _unwritable(self.folder, error) from error
        return path


def _schema(study: Study) -> Any:
    kinds = {float: pa.float64(), int: pa.int64(), str: pa.string()}
    columns = [("key", pa.string())]
    columns += [(name, kinds[type(each.default)]) for name, each in study.factors.items()]
    columns += [(name, pa.float64()) for name in study.keep]
    return pa.schema([*columns, ("error", pa.string()), ("sources", pa.string())])


def _unwritable(path: Path, error: OSError) -> StudyError:
    reason = error.strerror or str(error)
    remedy = "free some space" if error.errno == errno.ENOSPC else "make it writable"
    return StudyError(
        f"cannot write into {path}: {reason}. Rows that are there are kept: {remedy} and start "
        "again with the same --out, or choose another"
    )
