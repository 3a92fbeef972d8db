"""Feedback in a recorded run: its corrections, and the time from a picture to the board."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from der_planner.bags.run import Array

_SAME = 1e-6
"""Pressures that differ by less are the same number, written twice [Pa]."""
_LOOK_BACK = 40
"""Revisions before an estimate among which the one that it belongs to is looked for."""
BIN = 0.01
"""Width of a bin of the histogram of latencies [s]."""
_LONGEST = 0.5
"""Latencies above this are counted in the last bin [s]."""


@dataclass
class Revisions:
    """The revised setpoints of a plan, and the estimates that they rest on, as they were logged.

    Attributes:
        stamps: instants at which the revised setpoints take effect [ns].
        added: (M,) of each: the setpoint less the plan's [Pa].
        pictures: of each revision, the newest picture that it knows of [ns]; None: not told.
    """

    stamps: list[int] = field(default_factory=list)
    added: list[Array] = field(default_factory=list)
    pictures: list[int | None] = field(default_factory=list)

    def revised(self, stamp: int, added: Array) -> None:
        """Add a revised setpoint."""
        self.stamps.append(stamp)
        self.added.append(added)
        self.pictures.append(None)

    def estimated(self, picture: int, correction: Array) -> None:
        """Find the revision that was published with an estimate, by what both say was added.

        Args:
            picture: the newest picture that the estimate knows of [ns].
            correction: (M,) that it says was added [Pa].
        """
        if not np.any(correction):
            return
        for place in range(len(self.stamps) - 1, max(-1, len(self.stamps) - _LOOK_BACK), -1):
            same = len(self.added[place]) == len(correction)
            if same and np.abs(self.added[place] - correction).max() < _SAME:
                self.pictures[place] = picture
                return


def latencies(revisions: Revisions, pictures: NDArray[np.int64]) -> Array:
    """Return the times (n,) [s] from pictures to the first setpoints that know of them.

    A setpoint goes to the board at its stamp. Pictures that no later revision knows of are left
    out, as are those between which feedback was out.

    Args:
        revisions: of the plan.
        pictures: (K,) stamps of the pictures on which the limb was seen [ns].
    """
    known = [
        (picture, stamp)
        for stamp, picture in zip(revisions.stamps, revisions.pictures, strict=True)
        if picture is not None
    ]
    if not known:
        return np.empty(0)
    newest, stamp = np.array(known, dtype=np.int64).T
    order = np.argsort(newest, kind="stable")
    newest, stamp = newest[order], stamp[order]
    # The first setpoint among those that know of this picture or of a later one.
    first = np.minimum.accumulate(stamp[::-1])[::-1]
    inside = np.unique(pictures[(pictures >= newest[0]) & (pictures <= newest[-1])])
    taken: Array = (first[np.searchsorted(newest, inside)] - inside) * 1e-9
    return taken[(taken > 0) & (taken < _LONGEST)]


def described(added: Array, taken: Array) -> dict[str, Any]:
    """Return what feedback did, in numbers to be kept with a run.

    Args:
        added: (K, M) the setpoints that were played less the plan's [Pa].
        taken: (n,) from pictures to the setpoints that know of them [s].
    """
    about: dict[str, Any] = {
        "correction_rms_pa": np.sqrt(np.mean(added**2, axis=0)).tolist(),
        "correction_max_pa": np.abs(added).max(axis=0).tolist(),
    }
    if len(taken):
        median, late = np.quantile(taken, [0.5, 0.99])
        counts, _ = np.histogram(taken, bins=np.arange(0.0, _LONGEST + BIN / 2, BIN))
        about |= {
            "latency_median_s": float(median),
            "latency_p99_s": float(late),
            "latency_counts": counts.tolist(),
            "latency_bin_s": BIN,
        }
    return about
