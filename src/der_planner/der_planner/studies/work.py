"""What workers run: a calibration or some rows, one thread each, errors kept as results.

Workers import this module: they need the package, its dependencies and nothing of the study's
folder.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from threadpoolctl import threadpool_limits

from der_planner.studies import identity, twins
from der_planner.studies.tasks import TASKS, Values
from der_planner.studies.twins import Twin

_warm: set[str] = set()
"""Kinds of work that this process has done: its kernels are loaded."""


@dataclass(frozen=True)
class Calibrated:
    """A limb file's text, or why there is none."""

    limb: str = ""
    error: str = ""
    seconds: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """What became of one row.

    Attributes:
        results: by column; empty after an error.
        error: kind and message; empty if there was none.
    """

    results: dict[str, float] = field(default_factory=dict)
    error: str = ""


@dataclass(frozen=True)
class Report:
    """What a worker sends back for some rows.

    Attributes:
        outcomes: one for each row.
        seconds: that it took, without the wait for another process that compiles kernels.
        sources: digest of the worker's sources.
    """

    outcomes: tuple[Outcome, ...]
    seconds: float
    sources: str


def calibrate(twin: Twin, prior: str) -> Calibrated:
    """Return the calibrated limb of a twin, see `twins.calibrated`."""
    begin = time.perf_counter()
    with threadpool_limits(1), _first_alone("calibration"):
        try:
            limb, error = twins.calibrated(twin, prior), ""
        except Exception as problem:
            limb, error = "", f"calibration of {twin}: {_words(problem)}"
    return Calibrated(limb, error, time.perf_counter() - begin)


def compute(task: str, rows: Sequence[Values], limb: Calibrated) -> Report:
    """Compute rows of a task, beginning with a limb."""
    with threadpool_limits(1), _first_alone(task):
        begin = time.perf_counter()
        if limb.error:
            outcomes = [Outcome(error=limb.error)] * len(rows)
        else:
            outcomes = [_outcome(each) for each in TASKS[task].work(limb.limb, rows)]
        return Report(tuple(outcomes), time.perf_counter() - begin, identity.digest())


def _outcome(found: dict[str, float] | Exception) -> Outcome:
    if isinstance(found, Exception):
        return Outcome(error=_words(found))
    # Parquet tells NaN from nothing, people and JSON do not.
    return Outcome({k: v for k, v in found.items() if not math.isnan(v)})


def _words(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


@contextlib.contextmanager
def _first_alone(kind: str) -> Iterator[None]:
    """Let the first work of a kind on a machine finish before others of its kind begin.

    It compiles the kernels, which takes up to a minute; the others load them from numba's cache.
    """
    with contextlib.ExitStack() as stack:
        if kind not in _warm:
            stamp = identity.cache() / f"kernels-{identity.digest()}-{kind}"
            if not stamp.exists():
                stack.enter_context(identity.locked(stamp))
            yield
            stamp.touch()
            _warm.add(kind)
        else:
            yield


def probe() -> str:
    """Return the digest of this process's sources: that it answers shows that it can work."""
    return identity.digest()
