"""The limb from picture to picture: fitted, bridged where it is hidden, told with what is amiss.

The pictures' bodies may be tags of a camera or rigid bodies of a motion capture system.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.pose.shape import FollowerOptions, LimbEstimate, PlanarTag, ShapeFitter
from apriltag_tracker.tag_map import LimbGeometry

_STRETCH = 0.5
"""No soft limb is longer or shorter than at rest by more than this share."""


class Followed(NamedTuple):
    """What one picture says about the limb.

    Attributes:
        estimate: the limb; None if it cannot be told.
        reason: why there is no estimate, or what was bridged or left out.
        bridged: the estimate continues earlier motion; nothing of the limb was seen.
    """

    estimate: LimbEstimate | None
    reason: str
    bridged: bool = False


def survey_errors(
    places: NDArray[np.float64], fixed: NDArray[np.float64], survey: float, least_spread: float
) -> NDArray[np.float64]:
    """Return how what is on the limb moves with errors of the survey that all of it shares.

    Args:
        places: (n, 3) x, y [m], heading [rad] on the limb.
        fixed: (k, 2) of what was surveyed [m].
        survey: standard deviation of one of its positions [m].
        least_spread: of ``fixed`` about its middle, which tells the turn [m].

    Returns:
        (n, 3, 3): by a shift in x, in y, and a turn, of one standard deviation each.
    """
    middle = fixed.mean(axis=0)
    spread = max(float(np.sqrt(np.sum((fixed - middle) ** 2))), least_spread)
    shift, turn = survey / np.sqrt(len(fixed)), survey / spread
    moves = np.zeros((len(places), 3, 3))
    moves[:, 0, 0] = moves[:, 1, 1] = shift
    moves[:, :2, 2] = turn * (places[:, :2] - middle)[:, ::-1] * [-1.0, 1.0]
    moves[:, 2, 2] = turn
    return moves


class LimbFollower:
    """Fits the limb to what is seen of it, picture after picture.

    Args:
        geometry: of the limb, with the names of what can be seen on it.
        options: how it works.
        noun: what is seen: ``tag`` or ``body``.
        place: where it is seen: ``in the image``.
    """

    def __init__(
        self,
        geometry: LimbGeometry,
        options: FollowerOptions,
        noun: str = "tag",
        place: str = "in the image",
    ) -> None:
        self._names = geometry.limb_names
        self._options = options
        self._noun, self._place = noun, place
        self._fitter = ShapeFitter(geometry, options)
        self._history: list[tuple[float, LimbEstimate]] = []
        self._bridged = 0
        self.misplaced = 0
        """What was left out so far because it was on the wrong place."""

    def follow(
        self,
        seen: Sequence[PlanarTag],
        stamp: float,
        common: NDArray[np.float64] | None = None,
        shared_noise: NDArray[np.float64] | None = None,
        unfit: int = 0,
    ) -> Followed:
        """Take one picture.

        Args:
            seen: what was seen of the limb, each id once.
            stamp: of the picture [s].
            common: as of `ShapeFitter.fit`.
            shared_noise: as of `ShapeFitter.fit`.
            unfit: how many more were seen that have not the size that the map says.
        """
        estimate = self._fitter.fit(seen, common, shared_noise) if seen else None
        if estimate is None:
            cause = f"no limb {self._noun} {self._place}"
            if seen:
                cause = f"limb {self._noun}s contradict each other: check places, turns, units"
            elif unfit:
                cause = f"{unfit} limb {self._noun}(s) do not fit the map: check size and height"
            return self._bridge(stamp, cause)
        self.misplaced += len(estimate.rejected)
        problem, sigma = "", estimate.tip_sigma
        if sigma > self._options.largest_tip_sigma:
            problem = f"the tip is known to {1e3 * sigma:.0f} mm only"
        elif abs(estimate.elongation - 1.0) > _STRETCH:
            problem = f"the limb has {estimate.elongation:.2f} of the map's length: check its units"
        if problem:
            self._history.clear()
            return Followed(None, "; ".join(filter(None, (problem, self._remark(estimate)))))
        self._bridged = 0
        if self._history and stamp <= self._history[-1][0]:
            self._history.clear()
        self._history = [*self._history[-1:], (stamp, estimate)]
        return Followed(estimate, self._remark(estimate))

    def _remark(self, estimate: LimbEstimate) -> str:
        parts = []
        if estimate.rejected:
            wrong = ", ".join(
                f"{self._names[each]} ({1e3 * distance:.0f} mm off)"
                for each, distance in estimate.rejected.items()
            )
            parts.append(f"{self._noun} on the wrong place, left out: {wrong}")
        unseen = [
            name
            for each, name in self._names.items()
            if each not in estimate.tags_used and each not in estimate.rejected
        ]
        if unseen:
            parts.append(f"without {self._noun} {', '.join(unseen)}")
        return "; ".join(parts)

    def _bridge(self, stamp: float, cause: str) -> Followed:
        """Continue the last motion for a few frames, while the tip is known well enough."""
        self._bridged += 1
        estimate = self._continued(stamp)
        if estimate is None or estimate.tip_sigma > self._options.largest_tip_sigma:
            self._history.clear()
            self._fitter.reset()
            return Followed(None, cause)
        frames = "frame" if self._bridged == 1 else "frames"
        return Followed(estimate, f"bridged {self._bridged} {frames}: {cause}", bridged=True)

    def _continued(self, stamp: float) -> LimbEstimate | None:
        """Return where the last motion leads, with a covariance that grows."""
        if self._bridged > self._options.bridge_frames or len(self._history) < 2:
            return None
        (before, old), (last, new) = self._history
        share = (stamp - last) / (last - before)
        # A pause is no motion: frames are counted by their usual time, too.
        if not 0.0 < share < self._options.bridge_frames + 0.5:
            return None
        going = ("tip", "bend_angle", "curvature", "curve")
        gone = {name: share * (getattr(new, name) - getattr(old, name)) for name in going}
        # How wrong the continuation can be: as far as the limb went meanwhile, and a millimetre.
        growth = np.outer(gone["tip"], gone["tip"]) + 1e-6 * np.eye(2)
        return replace(
            new,
            **{name: getattr(new, name) + way for name, way in gone.items()},
            tip_covariance=new.tip_covariance + growth,
            bend_angle_sigma=new.bend_angle_sigma + np.abs(gone["bend_angle"]) + 0.01,
            tags_used=(),
            rejected={},
        )
