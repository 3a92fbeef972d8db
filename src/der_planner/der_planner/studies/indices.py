"""Sobol indices: which factor's error costs how much of the variance of a result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from der_planner.studies.store import Kept
from der_planner.studies.study import Study

CONFIDENCE = 0.95
_RESAMPLES = 500


@dataclass(frozen=True)
class Index:
    """Of one factor: shares of the variance of a result.

    Attributes:
        first: by this factor alone. total: also together with others.
        first_range, total_range: 95 % interval of each, by resampling the rows.
    """

    factor: str
    first: float
    total: float
    first_range: tuple[float, float]
    total_range: tuple[float, float]


def sobol_indices(study: Study, kept: Mapping[str, Kept], of: str) -> tuple[Index, ...]:
    """Return the Sobol indices of a result, by `scipy.stats.sobol_indices` (Saltelli 2010).

    Empty while rows are missing or where one has failed: the indices need every row.
    """
    if study.draw.method != "saltelli":
        return ()
    rows = [kept.get(row.key) for row in study.rows]
    count, names = study.draw.count, list(study.spreads)
    good = [row[of] for row in rows if row is not None and row[of] is not None]
    if len(good) != count * (len(names) + 2):
        return ()
    values = np.array(good)
    if np.ptp(values) == 0.0:
        return ()
    # It takes most of a second to import: only studies with Sobol indices pay for it.
    import scipy.stats  # noqa: PLC0415

    found = scipy.stats.sobol_indices(
        func={
            "f_A": values[None, :count],
            "f_B": values[None, count : 2 * count],
            "f_AB": values[2 * count :].reshape(len(names), 1, count),
        },
        n=count,
        rng=np.random.default_rng(0),
    )
    spread = found.bootstrap(confidence_level=CONFIDENCE, n_resamples=_RESAMPLES)
    return tuple(
        Index(
            name,
            float(np.ravel(found.first_order)[i]),
            float(np.ravel(found.total_order)[i]),
            _ends(spread.first_order.confidence_interval, i),
            _ends(spread.total_order.confidence_interval, i),
        )
        for i, name in enumerate(names)
    )


def _ends(interval: object, place: int) -> tuple[float, float]:
    low, high = (np.ravel(getattr(interval, name))[place] for name in ("low", "high"))
    return float(low), float(high)
