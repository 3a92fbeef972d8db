"""A study is played: rows go out to workers, come back, and are kept one by one.

Workers are processes of this machine, or of a Dask cluster that runs already. They import this
module: they need the package, its dependencies and nothing of the study's folder.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import os
import queue
import time
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from distributed import Client, Future, LocalCluster
from distributed.scheduler import KilledWorker
from threadpoolctl import threadpool_limits

from der_planner.experiment.console import Progress
from der_planner.studies import cache
from der_planner.studies.cache import Twin
from der_planner.studies.factors import StudyError
from der_planner.studies.store import Kept, Outcome, Store
from der_planner.studies.study import Row, Study
from der_planner.studies.tasks import TASKS, Values

_AHEAD = 20
"""Batchs of work under way for each thread of the cluster, so that none waits for its next."""
_LEAST_AHEAD = 200
"""Batchs of work under way in any case."""
_PAUSE = 0.5
"""The cluster is looked at again after this time [s] at the latest."""
_PATIENCE = 10.0
"""A scheduler that should be there is waited for this long [s]."""
ALONE = 30.0
"""New workers are started, or asked for, after this time [s] without any."""
_STARTS = 3
"""Starts of workers, one after the other, that may bring no row at all."""
_JOIN = "python3 scripts/workspace.py exec dask worker {} --nthreads 1"


class ClusterLostError(ConnectionError):
    """The scheduler is gone, or all processes of this machine, and what had not come back."""


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
        KeyboardInterrupt: it was stopped; what had come back is kept.
    """
    store = Store(settings.out, study)
    rows = study.rows[: settings.limit]
    kept = store.load()
    if store.unreadable:
        progress.say(f"{store.unreadable} files of rows were not whole: done again")
    again = {key for key, each in kept.items() if each["error"] and settings.retry_failed}
    missing = [row for row in rows if row.key not in kept or row.key in again]
    there = [kept[row.key] for row in rows if row.key in kept and row.key not in again]
    failed = sum(each["error"] is not None for each in there)
    if {each["sources"] for each in there} - {cache.digest()}:
        progress.say(
            "WARNING: some rows that are there were made by other sources or libraries; for rows "
            "that compare in the last digits choose another --out"
        )
    progress.say(
        f"{study.name}: {len(missing)} of {len(rows)} rows to do, into {settings.out}"
        + (f" ({failed} of those done have failed)" if failed else "")
    )
    if missing:
        store.forget({row.key for row in missing})
        conductor = _Conductor(study, settings, store, progress)
        conductor.done, conductor.failed, conductor.total = len(there), failed, len(rows)
        conductor.play(missing)
    done = store.load()
    return {row.key: done[row.key] for row in rows if row.key in done}


# On the workers ----------------------------------------------------------------------------------


class Calibrated(NamedTuple):
    """A limb file's text, or why there is none; and the digest of the worker's sources."""

    limb: str = ""
    error: str = ""
    sources: str = ""


class BatchReport(NamedTuple):
    """What a worker sends back for some rows.

    Attributes:
        outcomes: one for each row.
        seconds: that it took.
        sources: digest of the worker's sources.
    """

    outcomes: tuple[Outcome, ...]
    seconds: float
    sources: str


def calibrate(twin: Twin, prior: str) -> Calibrated:
    """Return the calibrated limb of a twin, see `cache.calibrated`."""
    try:
        return Calibrated(cache.calibrated(twin, prior), sources=cache.digest())
    except Exception as error:
        return Calibrated(error=f"calibration of {twin}: {_words(error)}", sources=cache.digest())


def compute(task: str, rows: Sequence[Values], limb: Calibrated) -> BatchReport:
    """Compute rows of a task, beginning with a limb; on one thread, errors kept as results."""
    begin = time.perf_counter()
    with threadpool_limits(1):
        outcomes = [_outcome(task, values, limb) for values in rows]
    # A limb that another version calibrated makes rows of another version.
    sources = limb.sources or cache.digest()
    return BatchReport(tuple(outcomes), time.perf_counter() - begin, sources)


def _outcome(task: str, values: Values, limb: Calibrated) -> Outcome:
    if limb.error:
        return Outcome({}, limb.error)
    try:
        found = TASKS[task].compute(limb.limb, values)
    except Exception as error:
        return Outcome({}, _words(error))
    # Parquet tells NaN from nothing, people and JSON do not.
    return Outcome({name: value for name, value in found.items() if not math.isnan(value)})


def _words(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


# On this machine ---------------------------------------------------------------------------------


@contextlib.contextmanager
def local(workers: int | None) -> Iterator[Client]:
    """Start worker processes with one thread each on this machine, one a core by default.

    Raises:
        StudyError: they did not start.
    """
    logging.getLogger("distributed").setLevel(logging.ERROR)
    try:
        cluster = LocalCluster(
            n_workers=workers or len(os.sched_getaffinity(0)),
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            memory_limit=0,
            silence_logs=logging.CRITICAL,
        )
    except (OSError, TimeoutError, RuntimeError) as error:
        raise StudyError(f"the workers of this machine did not start: {error}") from error
    with cluster, Client(cluster, set_as_default=False) as client:
        yield client


@contextlib.contextmanager
def remote(address: str, again: bool) -> Iterator[Client]:
    """Join a cluster by the address of its scheduler; one that was lost is waited for.

    Raises:
        StudyError: nothing answers there, and has not before.
    """
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    client: Client | None = None
    while client is None:
        try:
            client = Client(address, timeout=_PATIENCE, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            if again:
                time.sleep(_PAUSE)
                continue
            raise StudyError(
                f"no Dask scheduler answers at {address} ({error}): start one with 'dask "
                "scheduler', give the address that it prints, or leave --scheduler away to use "
                "this machine alone"
            ) from error
    try:
        yield client
    finally:
        with contextlib.suppress(Exception):
            client.close(timeout=2)


class Batch(NamedTuple):
    """Rows that one task computes; the batch with the lowest place is begun first."""

    rows: tuple[Row, ...]
    twin: Twin | None
    place: int


def batches(study: Study, rows: Sequence[Row]) -> Iterator[Batch]:
    """Return the rows in batches of what a task computes together; a batch has one twin."""
    place = itertools.count()
    for twin, group in itertools.groupby(rows, key=lambda row: study.task.twin(row.values)):
        left = list(group)
        for begin in range(0, len(left), study.task.batch):
            yield Batch(tuple(left[begin : begin + study.task.batch]), twin, next(place))


class _Conductor:
    """Sends rows out and keeps what comes back, on one cluster after another if need be."""

    def __init__(
        self, study: Study, settings: PlaySettings, store: Store, progress: Progress
    ) -> None:
        self._study, self._settings, self._store = study, settings, store
        self._progress = progress
        self.done = self.failed = self.total = 0
        self._begun, self._made = time.monotonic(), 0
        self._left: deque[Batch] = deque()
        self._sent: dict[str, tuple[Future, Batch]] = {}
        self._twins: dict[Twin, Future] = {}
        self._back: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._threads = 0
        self._seen = self._manned = 0.0

    def play(self, rows: Sequence[Row]) -> None:
        """Play rows, on a new cluster each time that one is lost.

        Raises:
            StudyError: the disk is full, no worker lasts, or one has other sources.
        """
        self._left.extend(batches(self._study, rows))
        scheduler, lost, starts = self._settings.scheduler, False, 0
        while self._left:
            made = self._made
            join = remote(scheduler, lost) if scheduler else local(self._settings.workers)
            try:
                with join as client:
                    self._play_on(client)
            except ClusterLostError as error:
                lost, starts = True, 1 if self._made > made else starts + 1
                if not scheduler and starts == _STARTS:
                    raise StudyError(
                        f"the worker processes of this machine ended {starts} times before a row "
                        "was done: see that memory and disk are not full. Rows that are there are "
                        "kept"
                    ) from error
                gone = "the worker processes of this machine are gone: starting new ones. "
                if scheduler:
                    gone = f"the scheduler at {scheduler} is gone: waiting for it to come back. "
                self._progress.say(f"{gone}{self.done} of {self.total} rows are kept")

    def _play_on(self, client: Client) -> None:
        """Play the batches that are left on one cluster.

        Raises:
            ClusterLostError: it is gone; what had not come back is left again.
        """
        workers = client.nthreads()
        where = self._settings.scheduler or "this machine"
        self._progress.say(
            f"{len(workers)} workers with {sum(workers.values())} threads at {where}; "
            f"dashboard: {client.dashboard_link}"
        )
        if not workers:
            self._progress.say(f"no worker has joined yet: {_JOIN.format(where)}")
        self._back = queue.SimpleQueue()
        self._manned = time.monotonic()
        try:
            while self._left or self._sent:
                self._check(client)
                self._send(client)
                with contextlib.suppress(queue.Empty):
                    self._keep(self._back.get(timeout=_PAUSE))
        finally:
            # What is under way is not lost, it is to do.
            self._left.extendleft(batch for _, batch in reversed(self._sent.values()))
            futures = [*(future for future, _ in self._sent.values()), *self._twins.values()]
            self._sent, self._twins = {}, {}
            if futures and client.status == "running":
                client.cancel(futures, force=True)
        self._show()

    def _check(self, client: Client) -> None:
        """See now and then whether the cluster is there, and show how far the study is."""
        now = time.monotonic()
        if now - self._seen < _PAUSE:
            return
        if client.status != "running":
            raise ClusterLostError(client.status)
        try:
            self._threads = sum(client.nthreads().values())
        except (OSError, TimeoutError, RuntimeError, ValueError) as error:
            raise ClusterLostError(str(error)) from error
        self._seen = now
        if self._threads:
            self._manned = now
        elif now - self._manned > ALONE:
            if not self._settings.scheduler:
                raise ClusterLostError("no process of this machine is left")
            self._manned = math.inf  # it is said once
            join = _JOIN.format(self._settings.scheduler)
            self._progress.say(f"no worker is there any more: {join}")
        self._show()

    def _send(self, client: Client) -> None:
        """Keep enough work under way."""
        task, ahead = self._study.task.name, max(_LEAST_AHEAD, _AHEAD * self._threads)
        while self._left and len(self._sent) < ahead:
            batch = self._left.popleft()
            limb: Any = Calibrated(self._study.limb)
            if batch.twin is not None:
                # One task, however many rows wait for it.
                if batch.twin not in self._twins:
                    key = "-".join(map(str, ("calibrate", *batch.twin)))
                    self._twins[batch.twin] = client.submit(
                        calibrate, batch.twin, self._study.limb, key=key, priority=-batch.place
                    )
                limb = self._twins[batch.twin]
            values = [row.values for row in batch.rows]
            key = f"{task}-{batch.rows[0].key}-{len(batch.rows)}"
            future = client.submit(compute, task, values, limb, key=key, priority=-batch.place)
            self._sent[future.key] = (future, batch)
            future.add_done_callback(self._back.put)

    def _keep(self, future: Future) -> None:
        """Keep the rows of a task that has come back."""
        if future.key not in self._sent:
            return
        if future.status in ("cancelled", "lost"):
            raise ClusterLostError(future.key)
        rows = self._sent[future.key][1].rows
        try:
            report = self._broken(future, rows) if future.status == "error" else future.result()
        except (OSError, TimeoutError) as error:
            raise ClusterLostError(str(error)) from error
        if report.sources != cache.digest():
            raise StudyError(
                "a worker has other sources or libraries than this program, so its rows would not "
                "compare: bring both to one version and start the worker again"
            )
        self._store.keep(rows, report.outcomes, report.sources)
        self._store.note(f"{rows[0].key},{len(rows)},{report.seconds:.3f}")
        del self._sent[future.key]
        self.done += len(rows)
        self._made += len(rows)
        for row, outcome in zip(rows, report.outcomes, strict=True):
            if outcome.error:
                self.failed += 1
                self._progress.say(f"  failed: {dict(row.values)}: {outcome.error}")

    def _broken(self, future: Future, rows: Sequence[Row]) -> BatchReport:
        """Return the report on rows whose worker ended under them again and again.

        Raises:
            StudyError: a worker could not even begin.
        """
        error = future.exception()
        if not isinstance(error, KilledWorker):
            raise StudyError(
                f"a worker cannot compute rows ({_words(error)}): start it in the workspace: "
                f"{_JOIN.format('ADDRESS')}"
            )
        return BatchReport((Outcome({}, _words(error)),) * len(rows), 0.0, cache.digest())

    def _show(self) -> None:
        rate = self._made / max(time.monotonic() - self._begun, 1e-9)
        left = clock((self.total - self.done) / rate) if self._made else "?"
        failed = f", {self.failed} failed" if self.failed else ""
        text = f"{rate:.3g} rows/s, {left} left, {self._threads} threads{failed}"
        self._progress.bar(self.done, self.total, text, unit="rows")


def clock(seconds: float) -> str:
    """Return a duration as people say it."""
    whole = round(seconds)
    if whole < 120:
        return f"{whole} s"
    if whole < 7200:
        return f"{whole // 60} min"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
