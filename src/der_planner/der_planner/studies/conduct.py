"""A study is played: rows go out to workers, come back, and are kept one by one.

Workers are processes of this machine, or of a Dask cluster that runs already. They import this
module: they need the package, its dependencies and nothing of the study's folder.

A row is kept as a line of JSON as soon as it comes back, so a study that was stopped goes on where
it was, whatever stopped it.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import json
import logging
import math
import os
import queue
import time
from collections.abc import Iterator, Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any, NamedTuple

from distributed import Client, Future, LocalCluster
from threadpoolctl import threadpool_limits

from der_planner.experiment.console import Progress, alone_in
from der_planner.studies.factors import StudyError, Value
from der_planner.studies.study import Row, Study
from der_planner.studies.tasks import TASKS, Twin, calibrated, digest

Kept = dict[str, Any]
"""A row as it is kept: key, factors, results, error and sources by column."""
_PAUSE = 0.5
"""Workers are counted again when no row came back for this time [s]."""
PATIENCE = 10.0
"""A scheduler that should be there is waited for this long [s]."""
ALONE = 30.0
"""Time [s] without any process of this machine after which a study ends."""
_JOIN = "python3 scripts/workspace.py exec dask worker {} --nthreads 1"
_KEPT = "Rows that are there are kept: the same command goes on from here"


class PlaySettings(NamedTuple):
    """How a study is played.

    Attributes:
        out: folder.
        scheduler: address of a running cluster; empty for processes of this machine.
        workers: of this machine; None for one a core.
        limit: most rows of the table; None for all.
        retry_failed: do rows again that ended with an error.
    """

    out: Path
    scheduler: str = ""
    workers: int | None = None
    limit: int | None = None
    retry_failed: bool = False


def conduct(study: Study, settings: PlaySettings, progress: Progress) -> dict[str, Kept]:
    """Play the missing rows of a study; return every row that is done, by key, in order.

    Raises:
        StudyError: the folder cannot be written, or no cluster can compute the rows.
        OptionError: the folder is in use by another study.
        KeyboardInterrupt: it was stopped; what had come back is kept.
    """
    store = Store(settings.out, study)
    rows = study.rows[: settings.limit]
    there = {
        key: each
        for key, each in store.load().items()
        if not (each["error"] and settings.retry_failed)
    }
    missing = [row for row in rows if row.key not in there]
    done = [there[row.key] for row in rows if row.key in there]
    failed = sum(each["error"] is not None for each in done)
    if {each["sources"] for each in done} - {digest()}:
        progress.say(
            "WARNING: some rows that are there were made by other sources or libraries; for rows "
            "that compare in the last digits choose another --out"
        )
    progress.say(
        f"{study.name}: {len(missing)} of {len(rows)} rows to do, into {settings.out}"
        + (f" ({failed} of those done have failed)" if failed else "")
    )
    if missing:
        with alone_in(settings.out), _cluster(settings) as client:
            _Conductor(study, settings.scheduler, store, progress).play(client, missing)
    kept = store.load()
    return {row.key: kept[row.key] for row in rows if row.key in kept}


# Rows on disk ------------------------------------------------------------------------------------


class Outcome(NamedTuple):
    """What became of one row.

    Attributes:
        results: by column; empty after an error.
        error: kind and message.
        sources: digest of the sources that computed it.
    """

    results: dict[str, float]
    error: str = ""
    sources: str = ""


class Store:
    """The folder of a study: ``study.yaml``, ``rows.jsonl``, at its end ``rows.csv``.

    Args:
        folder: made if missing.
        study: whose rows are kept.

    Raises:
        StudyError: the folder cannot be written.
    """

    def __init__(self, folder: Path, study: Study) -> None:
        self.folder, self._study = folder, study
        self._rows = folder / "rows.jsonl"
        with self.written():
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "study.yaml").write_text(study.text, encoding="utf-8")
            self._rows.touch()

    @contextlib.contextmanager
    def written(self) -> Iterator[None]:
        """Say what helps where the folder cannot be written."""
        try:
            yield
        except OSError as error:
            remedy = "free some space" if error.errno == errno.ENOSPC else "make it writable"
            raise StudyError(
                f"cannot write into {self.folder}: {error.strerror or error}. Rows that are there "
                f"are kept: {remedy} and start again with the same --out, or choose another"
            ) from error

    def keep(self, row: Row, outcome: Outcome) -> None:
        """Append a finished row; of lines with one key the last counts.

        Raises:
            StudyError: the disk is full, or the folder cannot be written any more.
        """
        results = {name: outcome.results.get(name) for name in self._study.keep}
        ended = {"error": outcome.error or None, "sources": outcome.sources}
        line = json.dumps({"key": row.key, **row.values, **results, **ended}, allow_nan=False)
        with self.written(), self._rows.open("a", encoding="utf-8") as file:
            file.write(f"\n{line}")  # the line break comes first: it ends a line that was cut off

    def load(self) -> dict[str, Kept]:
        """Return the rows of the study that are done, by key, in the order of the table.

        A line that is not whole, as after a kill, is passed over. A row that was kept without a
        column that the study now asks for counts as not done.
        """
        found: dict[str, Kept] = {}
        for line in self._rows.read_text(encoding="utf-8", errors="replace").splitlines():
            with contextlib.suppress(json.JSONDecodeError):
                record = json.loads(line)
                if record.keys() >= set(self._study.keep):
                    found[record["key"]] = record
        return {row.key: found[row.key] for row in self._study.rows if row.key in found}

    def write_table(self, kept: Mapping[str, Kept]) -> None:
        """Write all rows as one table, ``rows.csv``, in the order of the study."""
        columns = ["key", *self._study.factors, *self._study.keep, "error", "sources"]
        with self.written(), (self.folder / "rows.csv").open("w", newline="") as file:
            table = csv.DictWriter(file, columns, extrasaction="ignore")
            table.writeheader()
            table.writerows(kept.values())


# On the workers ----------------------------------------------------------------------------------


def compute(task: str, values: Mapping[str, Value], limb: str) -> Outcome:
    """Compute a row of a task, on one thread; an error is kept as a result.

    Args:
        task: name.
        values: of the factors that the study names.
        limb: text of the limb file that the row begins with; empty for the default limb.
    """
    try:
        with threadpool_limits(1):
            found = TASKS[task].compute(limb, values)
    except Exception as error:
        return Outcome({}, _words(error), digest())
    # JSON has no NaN: what is not known is left out.
    told = {name: value for name, value in found.items() if not math.isnan(value)}
    return Outcome(told, sources=digest())


def _words(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


# The cluster -----------------------------------------------------------------------------------


def local_cluster(workers: int) -> LocalCluster:
    """Return so many processes of this machine, with one thread each."""
    return LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        memory_limit=0,
        silence_logs=logging.CRITICAL,
    )


@contextlib.contextmanager
def _cluster(settings: PlaySettings) -> Iterator[Client]:
    """Join a cluster, or start processes with one thread each on this machine.

    Raises:
        StudyError: nothing answers at the address, or the processes did not start.
    """
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with contextlib.ExitStack() as stack:
        try:
            where: Any = settings.scheduler
            if not where:
                count = settings.workers or len(os.sched_getaffinity(0))
                where = stack.enter_context(local_cluster(count))
            client = Client(where, timeout=PATIENCE, set_as_default=False)
        except (OSError, TimeoutError, RuntimeError, ValueError) as error:
            raise StudyError(
                f"no Dask scheduler answers at {settings.scheduler or 'this machine'} ({error}): "
                "start one with 'dask scheduler' and give the address that it prints, or leave "
                "--scheduler away to use this machine alone"
            ) from error
        try:
            yield client
        finally:
            with contextlib.suppress(Exception):
                client.close(timeout=2)


class _Conductor:
    """Sends rows out to a cluster and keeps what comes back."""

    def __init__(self, study: Study, scheduler: str, store: Store, progress: Progress) -> None:
        self._study, self._scheduler = study, scheduler
        self._store, self._progress = store, progress
        self._sent: dict[str, tuple[Future, Row]] = {}
        self._twins: dict[Twin, Future] = {}
        self._back: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._begun, self._alone = time.monotonic(), 0.0
        self._threads = self._made = self._failed = 0

    def play(self, client: Client, rows: Sequence[Row]) -> None:
        """Play rows.

        Raises:
            StudyError: the disk is full, the cluster is gone, or a worker has other sources.
        """
        where = self._scheduler or "this machine"
        workers = client.nthreads()
        self._threads = sum(workers.values())
        self._progress.say(f"{len(workers)} workers at {where}; dashboard: {client.dashboard_link}")
        if not workers:
            self._progress.say(f"no worker has joined yet: {_JOIN.format(where)}")
        try:
            for place, row in enumerate(rows):
                self._send(client, place, row)
            while self._sent:
                try:
                    self._keep(self._back.get(timeout=_PAUSE))
                except queue.Empty:
                    self._check_workers(client)
                self._show(len(rows))
        finally:
            futures = [*(future for future, _ in self._sent.values()), *self._twins.values()]
            if futures and client.status == "running":
                client.cancel(futures, force=True)

    def _check_workers(self, client: Client) -> None:
        """Count the workers, after a pause in which no row came back.

        Raises:
            StudyError: the scheduler is gone, or every process of this machine.
        """
        try:
            if client.status != "running":
                raise OSError(client.status)
            self._threads = sum(client.nthreads().values())
        except (OSError, TimeoutError, RuntimeError, ValueError) as error:
            raise StudyError(f"the scheduler is gone ({error}). {_KEPT}") from error
        self._alone = 0.0 if self._threads or self._scheduler else self._alone + _PAUSE
        if self._alone > ALONE:
            raise StudyError(f"no worker process of this machine is left. {_KEPT}")

    def _send(self, client: Client, place: int, row: Row) -> None:
        """Send a row out; the one with the lowest place is begun first."""
        limb: Any = self._study.limb
        twin = self._study.task.twin(row.values)
        if twin is not None:
            # One task, however many rows wait for it.
            if twin not in self._twins:
                told = twin, self._study.limb
                self._twins[twin] = client.submit(calibrated, *told, priority=-place)
            limb = self._twins[twin]
        task, key = self._study.task.name, f"row-{row.key}"
        future = client.submit(compute, task, dict(row.values), limb, key=key, priority=-place)
        self._sent[future.key] = (future, row)
        future.add_done_callback(self._back.put)

    def _keep(self, future: Future) -> None:
        """Keep the row of a task that has come back."""
        _, row = self._sent[future.key]
        try:
            if future.status not in ("finished", "error"):
                raise OSError(future.status)
            outcome = self._broken(future) if future.status == "error" else future.result()
        except (OSError, TimeoutError) as error:
            raise StudyError(f"the scheduler is gone ({error}). {_KEPT}") from error
        if outcome.sources != digest():
            raise StudyError(
                "a worker has other sources or libraries than this program, so its rows would not "
                "compare: bring both to one version and start the worker again"
            )
        self._store.keep(row, outcome)
        del self._sent[future.key]
        self._made += 1
        if outcome.error:
            self._failed += 1
            self._progress.say(f"  failed: {dict(row.values)}: {outcome.error}")

    def _broken(self, future: Future) -> Outcome:
        """Return the outcome of a row whose twin or whose workers failed again and again.

        Raises:
            StudyError: a worker could not even begin.
        """
        error = future.exception()
        if isinstance(error, ImportError):
            raise StudyError(
                f"a worker cannot compute rows ({_words(error)}): start it in the workspace: "
                f"{_JOIN.format('ADDRESS')}"
            )
        return Outcome({}, _words(error), digest())

    def _show(self, total: int) -> None:
        rate = self._made / max(time.monotonic() - self._begun, 1e-9)
        left = timedelta(seconds=round((total - self._made) / rate)) if self._made else "?"
        failed = f", {self._failed} failed" if self._failed else ""
        text = f"{rate:.3g} rows/s, {left} left, {self._threads} threads{failed}"
        self._progress.bar(self._made, total, text, unit="rows")
