"""A study is played: rows go out to workers, come back, and are kept one by one."""

from __future__ import annotations

import itertools
import queue
import time
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import Any

from distributed import Client, Future
from distributed.scheduler import KilledWorker

from der_planner.experiment.console import Progress
from der_planner.studies import cluster, identity, work
from der_planner.studies.cluster import NoSchedulerError, SchedulerLostError, WorkersLostError
from der_planner.studies.errors import StudyError
from der_planner.studies.store import Kept, Store
from der_planner.studies.study import Row, Study
from der_planner.studies.twins import Twin
from der_planner.studies.work import Calibrated, Outcome

_AHEAD = 20
"""Pieces of work under way for each thread of the cluster, so that none waits for its next."""
_LEAST_AHEAD = 200
_LOOK = 0.5
"""Longest time without a look at the cluster [s]."""
_RETRY = 2.0
"""Between two attempts to find a lost scheduler [s]."""
ALONE = 30.0
"""Time without any worker after which new ones are started, or asked for [s]."""
_STARTS = 3
"""Starts of workers, one after the other, that may bring no row at all."""


@dataclass(frozen=True)
class Settings:
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


@dataclass(frozen=True)
class Piece:
    """Rows that one task computes; the piece with the lowest place is begun first."""

    rows: tuple[Row, ...]
    twin: Twin | None
    place: int


@dataclass
class _State:
    """Rows that are left to do, and rows that are under way."""

    left: deque[Piece]
    done: int
    failed: int
    total: int
    begun: float = field(default_factory=time.monotonic)
    made: int = 0
    sent: dict[str, tuple[Future, Piece]] = field(default_factory=dict)
    twins: dict[Twin, Future] = field(default_factory=dict)
    need: Counter[Twin] = field(default_factory=Counter)


def conduct(study: Study, settings: Settings, progress: Progress) -> dict[str, Kept]:
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
    state = _State(
        left=deque(pieces(study, missing)),
        done=len(there),
        failed=sum(each["error"] is not None for each in there),
        total=len(rows),
    )
    state.need = Counter(piece.twin for piece in state.left if piece.twin is not None)
    if {each["sources"] for each in there} - {identity.digest()}:
        progress.say(
            "WARNING: some rows that are there were made by other sources or libraries; for rows "
            "that compare in the last digits choose another --out"
        )
    progress.say(
        f"{study.name}: {len(missing)} of {len(rows)} rows to do, into {settings.out}"
        + (f" ({state.failed} of those done have failed)" if state.failed else "")
    )
    if missing:
        store.forget({row.key for row in missing})
        _play(study, settings, store, state, progress)
    done = store.load()
    return {row.key: done[row.key] for row in rows if row.key in done}


def pieces(study: Study, rows: list[Row]) -> Iterator[Piece]:
    """Return the rows in pieces of what a task computes together; a piece has one twin."""
    place = 0
    for twin, group in itertools.groupby(rows, key=lambda row: study.task.twin(row.values)):
        left = list(group)
        for begin in range(0, len(left), study.task.batch):
            yield Piece(tuple(left[begin : begin + study.task.batch]), twin, place)
            place += 1


def _play(
    study: Study, settings: Settings, store: Store, state: _State, progress: Progress
) -> None:
    """Play the rows that are left, on a new cluster each time that a scheduler is lost."""

    def join() -> AbstractContextManager[Client]:
        if settings.scheduler:
            return cluster.remote(settings.scheduler)
        return cluster.local(settings.workers)

    lost, starts = False, 0
    while state.left:
        made = state.made
        try:
            with join() as client:
                _welcome(client, settings, progress)
                lost = False
                _Session(study, store, state, client, progress, settings.scheduler).run()
        except WorkersLostError as error:
            starts = 1 if state.made > made else starts + 1
            if starts == _STARTS:
                raise StudyError(
                    f"the worker processes of this machine ended {starts} times before a row was "
                    "done: see that memory and disk are not full. Rows that are there are kept"
                ) from error
            progress.say(
                "the worker processes of this machine are gone: starting new ones. "
                f"{state.done} of {state.total} rows are kept"
            )
        except SchedulerLostError:
            progress.say(
                f"the scheduler at {settings.scheduler} is gone: waiting for it to come back. "
                f"{state.done} of {state.total} rows are kept"
            )
            lost = True
        except NoSchedulerError:
            if not lost:
                raise
            time.sleep(_RETRY)


def _welcome(client: Client, settings: Settings, progress: Progress) -> None:
    cluster.check_workers(client)
    workers = client.nthreads()
    where = settings.scheduler or "this machine"
    progress.say(
        f"{len(workers)} workers with {sum(workers.values())} threads at {where}; "
        f"dashboard: {_dashboard(client)}"
    )
    if not workers:
        progress.say(f"no worker has joined yet: {_how_to_join(settings.scheduler)}")


def _how_to_join(scheduler: str) -> str:
    return f"python3 scripts/workspace.py exec dask worker {scheduler} --nthreads 1"


def _dashboard(client: Client) -> str:
    if "dashboard" not in client.scheduler_info(n_workers=0).get("services", {}):
        return "none, the scheduler was started without"
    link = client.dashboard_link
    try:
        import bokeh  # type: ignore[import-not-found]  # noqa: F401, PLC0415
    except ImportError:
        return f"{link} (its pages need: .venv/bin/pip install bokeh)"
    return str(link)


class _Session:
    """The work on one cluster until nothing is left or its scheduler is lost.

    ``scheduler`` is the address of a cluster of others, empty for processes of this machine.
    """

    def __init__(
        self,
        study: Study,
        store: Store,
        state: _State,
        client: Client,
        progress: Progress,
        scheduler: str,
    ) -> None:
        self._study, self._store, self._state = study, store, state
        self._client, self._progress, self._scheduler = client, progress, scheduler
        self._manned = time.monotonic()
        self._asked = False
        self._back: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._threads = 0
        self._looked = -1e9

    def run(self) -> None:
        """Play the pieces that are left.

        Raises:
            SchedulerLostError: the scheduler is gone; what had not come back is left again.
            WorkersLostError: the same of all processes of this machine.
            StudyError: the disk is full, or a worker has other sources.
        """
        state = self._state
        try:
            while state.left or state.sent:
                self._look()
                self._send()
                self._take(self._next())
        finally:
            # What is under way is not lost, it is to do.
            state.left.extendleft(piece for _, piece in reversed(state.sent.values()))
            futures = [future for future, _ in state.sent.values()] + list(state.twins.values())
            state.sent, state.twins = {}, {}
            if futures and self._client.status == "running":
                self._client.cancel(futures, force=True)
        self._show()

    def _look(self) -> None:
        """See now and then what the cluster is, and show how far the study is."""
        if time.monotonic() - self._looked < _LOOK:
            return
        if self._client.status != "running":
            raise SchedulerLostError(self._client.status)
        try:
            self._threads = sum(self._client.nthreads().values())
        except (OSError, TimeoutError, RuntimeError, ValueError) as error:
            raise SchedulerLostError(str(error)) from error
        self._looked = time.monotonic()
        self._miss_workers()
        self._show()

    def _miss_workers(self) -> None:
        """Start again, or ask for workers, when there has been none for `ALONE`."""
        if self._threads:
            self._manned, self._asked = self._looked, False
        elif self._looked - self._manned > ALONE:
            if not self._scheduler:
                raise WorkersLostError("no process of this machine is left")
            if not self._asked:
                self._progress.say(f"no worker is there any more: {_how_to_join(self._scheduler)}")
            self._asked = True

    def _send(self) -> None:
        """Keep enough work under way."""
        state = self._state
        ahead = max(_LEAST_AHEAD, _AHEAD * self._threads)
        while state.left and len(state.sent) < ahead:
            piece = state.left.popleft()
            limb: Any = Calibrated(self._study.limb)
            if piece.twin is not None:
                limb = self._twin(piece.twin, piece.place)
            future = self._client.submit(
                work.compute,
                self._study.task.name,
                [row.values for row in piece.rows],
                limb,
                key=f"{self._study.task.name}-{piece.rows[0].key}-{len(piece.rows)}",
                priority=-piece.place,
            )
            state.sent[future.key] = (future, piece)
            future.add_done_callback(self._back.put)

    def _twin(self, twin: Twin, place: int) -> Future:
        """Return the calibration of a twin: one task, however many rows wait for it."""
        if twin not in self._state.twins:
            self._state.twins[twin] = self._client.submit(
                work.calibrate,
                twin,
                self._study.limb,
                key="-".join(map(str, ("calibrate", *astuple(twin)))),
                priority=-place,
            )
        return self._state.twins[twin]

    def _next(self) -> Future | None:
        try:
            return self._back.get(timeout=_LOOK)
        except queue.Empty:
            return None

    def _take(self, future: Future | None) -> None:
        """Keep the rows of a task that has come back."""
        state = self._state
        if future is None or future.key not in state.sent:
            return
        if future.status in ("cancelled", "lost"):
            raise SchedulerLostError(future.key)
        piece = state.sent[future.key][1]
        try:
            if future.status == "error":
                outcomes, sources, spent = self._broken(future, piece), identity.digest(), 0.0
            else:
                report = future.result()
                outcomes, sources, spent = report.outcomes, report.sources, report.seconds
        except (OSError, TimeoutError) as error:
            raise SchedulerLostError(str(error)) from error
        if sources != identity.digest():
            raise StudyError(cluster.other_version("that joined the cluster meanwhile"))
        self._store.keep(piece.rows, outcomes, sources)
        self._store.note([(piece.rows[0].key, str(len(piece.rows)), spent)])
        del state.sent[future.key]
        if piece.twin is not None:
            state.need[piece.twin] -= 1
            if not state.need[piece.twin]:
                state.twins.pop(piece.twin, None)
        state.done += len(piece.rows)
        state.made += len(piece.rows)
        for row, outcome in zip(piece.rows, outcomes, strict=True):
            if outcome.error:
                state.failed += 1
                self._progress.say(f"  failed: {dict(row.values)}: {outcome.error}")

    def _broken(self, future: Future, piece: Piece) -> tuple[Outcome, ...]:
        """Return outcomes of rows whose worker ended under them again and again.

        Raises:
            StudyError: a worker could not even begin.
        """
        error = future.exception()
        if not isinstance(error, KilledWorker):
            raise StudyError(
                f"a worker cannot compute rows ({type(error).__name__}: {error}): start it in the "
                "workspace: python3 scripts/workspace.py exec dask worker ADDRESS"
            )
        return (Outcome(error=f"{type(error).__name__}: {error}"),) * len(piece.rows)

    def _show(self) -> None:
        state = self._state
        spent = time.monotonic() - state.begun
        rate = state.made / spent if spent > 0 else 0.0
        left = clock((state.total - state.done) / rate) if state.made else "?"
        failed = f", {state.failed} failed" if state.failed else ""
        self._progress.bar(
            state.done,
            state.total,
            f"{rate:.3g} rows/s, {left} left, {self._threads} threads{failed}",
            unit="rows",
        )


def clock(seconds: float) -> str:
    """Return a duration as people say it."""
    whole = round(seconds)
    if whole < 120:
        return f"{whole} s"
    if whole < 7200:
        return f"{whole // 60} min"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
