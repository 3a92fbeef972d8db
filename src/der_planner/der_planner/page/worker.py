"""A process beside the page for what takes long, so that the page and its vent stay alive."""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import ParamSpec, TypeVar

Given = ParamSpec("Given")
Result = TypeVar("Result")

NICENESS = 5
"""Of the process: others go first."""
_PR_SET_PDEATHSIG = 1


class Worker:
    """One process that calls functions one after the other; started by the first call."""

    def __init__(self) -> None:
        self._pool: ProcessPoolExecutor | None = None

    def ask(
        self, function: Callable[Given, Result], *args: Given.args, **kwargs: Given.kwargs
    ) -> Future[Result]:
        """Call a function of a module there; a process that has died is started anew."""
        if self._pool is not None:
            with contextlib.suppress(BrokenProcessPool):
                return self._pool.submit(function, *args, **kwargs)
        self._pool = ProcessPoolExecutor(
            1, multiprocessing.get_context("spawn"), initializer=_settle_in
        )
        return self._pool.submit(function, *args, **kwargs)

    def close(self) -> None:
        """End the process, also in the middle of a call."""
        pool, self._pool = self._pool, None
        if pool is None:
            return
        workers = list((pool._processes or {}).values())
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            worker.kill()


def _settle_in() -> None:
    """Leave interrupts to the page, end with it whatever ends it, and let others go first."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    os.nice(NICENESS)
