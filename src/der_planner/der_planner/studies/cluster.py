"""Where rows are computed: processes of this machine, or a Dask cluster that runs already."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Iterator

from distributed import Client, LocalCluster
from distributed.comm import CommClosedError

from der_planner.studies import identity, work
from der_planner.studies.errors import StudyError

_PATIENCE = 10.0
"""Longest wait for a scheduler that should be there [s]."""


class SchedulerLostError(ConnectionError):
    """The scheduler is gone, and with it what had not come back."""


class WorkersLostError(ConnectionError):
    """The processes of this machine are gone, and none has come in their place."""


class NoSchedulerError(StudyError):
    """Nothing answers at the address of a scheduler."""


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
def remote(address: str) -> Iterator[Client]:
    """Join a cluster by the address of its scheduler.

    Raises:
        NoSchedulerError: nothing answers there.
    """
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise NoSchedulerError(
            f"no Dask scheduler answers at {address} ({error}): start one with 'dask scheduler', "
            "give the address that it prints, or leave --scheduler away to use this machine alone"
        ) from error
    try:
        yield client
    finally:
        with contextlib.suppress(Exception):
            client.close(timeout=2)


def check_workers(client: Client) -> None:
    """See that the workers that are there have this version of the sources.

    Raises:
        StudyError: a worker lacks the package or has another version; names it.
    """
    mine = identity.digest()
    try:
        answers = client.run(work.probe, on_error="return")
    except (OSError, TimeoutError) as error:
        raise SchedulerLostError(str(error)) from error
    for worker, answer in answers.items():
        if isinstance(answer, CommClosedError):
            continue  # it ended meanwhile: whoever counts the workers notices
        if isinstance(answer, Exception):
            raise StudyError(
                f"worker {worker} cannot compute rows ({type(answer).__name__}: {answer}): start "
                "it in the workspace: python3 scripts/workspace.py exec dask worker ADDRESS"
            )
        if answer != mine:
            raise StudyError(other_version(worker))


def other_version(worker: str) -> str:
    """Return what to say of a worker with other sources."""
    return (
        f"worker {worker} has other sources or libraries than this program, so its rows would not "
        "compare: bring both to one version and start the worker again"
    )
