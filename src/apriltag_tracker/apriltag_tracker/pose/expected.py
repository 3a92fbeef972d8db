"""Where tags of the limb must be, and how they are smeared, from those that were found.

The shape that fits the found tags says where the others are; what these tags leave open goes on as
it went in the last three pictures. How a tag is smeared follows from how the others are: they all
sit on a limb whose segments bend, each at one rate.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.camera import CameraPose, Intrinsics, project
from apriltag_tracker.detection.tag import ExpectedTag, Tag
from apriltag_tracker.pose.plane import centreline_pose, locate
from apriltag_tracker.pose.shape import PlanarTag, ShapeFitter
from apriltag_tracker.tag_map import UNIT_CORNERS, LimbTag, TagMap

_STEP = 1e-4
"""Of curvature, for derivatives by differences [1/m]."""

_MOST_SIGNS = 5
"""Tags whose smear has a sign to find; more than these tell nothing new."""

_WEAK = 0.1
"""Keeps a segment still that no tag says anything of [px per 1/m]."""

_REMEMBERED = 3
"""Pictures whose shapes are continued."""

_LONGEST_GAP = 0.2
"""After a longer time the motion before says nothing [s]."""


class TagPredictor:
    """Predicts tags of the limb from those that were found in the same picture.

    Args:
        tags: the tag map.
        intrinsics: of the camera.
        fitter: of the limb's shape; remembers the last one.
    """

    def __init__(self, tags: TagMap, intrinsics: Intrinsics, fitter: ShapeFitter) -> None:
        self._entries = {tag.id: tag for tag in tags.limb}
        self._intrinsics = intrinsics
        self._fitter = fitter
        self._shapes: list[tuple[float, NDArray[np.float64]]] = []

    def remember(self, stamp: float, parameters: NDArray[np.float64]) -> None:
        """Take the shape of a picture, as the fitter's parameters, with its stamp [s]."""
        if self._shapes and not 0.0 < stamp - self._shapes[-1][0] < _LONGEST_GAP:
            self._shapes.clear()
        self._shapes = [*self._shapes[1 - _REMEMBERED :], (stamp, parameters)]

    def _continued(self, stamp: float) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Return the parameters of the shape, and their rates a second, as they went before."""
        if not self._shapes or not 0.0 < stamp - self._shapes[-1][0] < _LONGEST_GAP:
            return None
        times = np.array([time for time, _ in self._shapes]) - stamp
        # The parabola through the last three, in powers of the time from now.
        powers = np.linalg.inv(np.vander(times, increasing=True))
        known = np.array([parameters for _, parameters in self._shapes])
        rates = powers[1] @ known if len(times) > 1 else np.zeros(known.shape[1])
        return powers[0] @ known, rates

    def predict(self, found: Sequence[Tag], pose: CameraPose, stamp: float) -> list[ExpectedTag]:
        """Return what is not among the found tags, next to one that is first.

        Args:
            found: tags of this picture.
            pose: of the camera.
            stamp: of this picture [s].
        """
        seen = [tag for tag in found if tag.id in self._entries]
        hidden = [entry for entry in self._entries.values() if entry.id not in {t.id for t in seen}]
        if not seen or not hidden:
            return []
        shown = [self._entries[tag.id] for tag in seen]
        hidden.sort(key=lambda entry: min(abs(entry.arc_length - s.arc_length) for s in shown))
        entries = [*shown, *hidden]
        before = self._continued(stamp)
        places, by_bend = self._fitter.elsewhere(
            self._on_plane(seen, shown, pose),
            [entry.arc_length for entry in entries],
            None if before is None else before[0],
        )
        corners, slopes = self._seen(entries, places, by_bend, pose)
        smears = np.array([tag.smear for tag in seen])
        changes = [_bend_changes(smears, slopes[: len(seen)])]
        if before is not None:
            rates = self._fitter.bends(before[1])
            changes.insert(0, rates * _exposure(smears, slopes[: len(seen)] @ rates))
        edge = (self._intrinsics.width - 1.0, self._intrinsics.height - 1.0)
        return [
            ExpectedTag(entries[k].id, corners[k], tuple(slopes[k] @ change for change in changes))
            for k in range(len(seen), len(entries))
            if np.all((corners[k] > 0.0) & (corners[k] < edge))
        ]

    def _seen(
        self,
        entries: Sequence[LimbTag],
        places: NDArray[np.float64],
        by_bend: NDArray[np.float64],
        pose: CameraPose,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return corners (n, 4, 2) px and how middles move with bends, (n, 2, M) px per 1/m."""
        corners = self._corners(entries, places, pose)
        moved = [
            self._corners(entries, places + _STEP * by_bend[:, :, k], pose)
            for k in range(by_bend.shape[2])
        ]
        slopes = [(there - corners).mean(axis=1) / _STEP for there in moved]
        return corners, np.stack(slopes, axis=2)

    def _on_plane(
        self, seen: Sequence[Tag], entries: Sequence[LimbTag], pose: CameraPose
    ) -> list[PlanarTag]:
        places, spreads, _ = locate(
            np.array([tag.corners for tag in seen]),
            np.array([tag.covariance for tag in seen]),
            np.array([entry.height for entry in entries]),
            np.array([entry.size for entry in entries]),
            self._intrinsics,
            pose,
        )
        return [
            PlanarTag(entry.id, entry.arc_length, centreline_pose(place, entry), spread)
            for entry, place, spread in zip(entries, places, spreads, strict=True)
        ]

    def _corners(
        self, entries: Sequence[LimbTag], places: NDArray[np.float64], pose: CameraPose
    ) -> NDArray[np.float64]:
        """Return the pixels (n, 4, 2) of tags whose centreline is at `places` (n, 3)."""
        points = np.empty((len(entries), 4, 3))
        for k, entry in enumerate(entries):
            along, across, turn = entry.offset
            x, y, heading = places[k]
            cosine, sine = np.cos(heading), np.sin(heading)
            points[k, :, :2] = (
                x + cosine * along - sine * across,
                y + sine * along + cosine * across,
            )
            cosine, sine = np.cos(heading + turn), np.sin(heading + turn)
            points[k, :, :2] += entry.size * UNIT_CORNERS @ [[cosine, sine], [-sine, cosine]]
            points[k, :, 2] = entry.height
        return project(self._intrinsics, pose, points.reshape(-1, 3)).reshape(-1, 4, 2)


def _exposure(smears: NDArray[np.float64], velocities: NDArray[np.float64]) -> float:
    """Return in which time [s] tags of velocities (n, 2) px/s get smears (n, 2) px."""
    speeds = np.hypot(*velocities.T)
    return float(np.hypot(*smears.T) @ speeds / max(float(speeds @ speeds), 1e-9))


def _bend_changes(smears: NDArray[np.float64], slopes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Find by how much segments bent during the exposure, from smears whose signs are not known.

    Args:
        smears: (n, 2) px.
        slopes: (n, 2, M) px per 1/m: how tags move with the segments' curvatures.

    Returns:
        Changes (M,) of curvature [1/m], for the combination of signs that fits best.
    """
    order = np.argsort(-np.hypot(*smears.T))
    count = min(_MOST_SIGNS, int(np.count_nonzero(smears.any(axis=1))))
    segments = slopes.shape[2]
    if count == 0:
        return np.zeros(segments)
    # Tags that stand still say so whatever the signs are.
    used = np.concatenate([order[:count], order[~smears[order].any(axis=1)]])
    rows = np.concatenate([slopes[used].reshape(-1, segments), _WEAK * np.eye(segments)])
    signs = np.array([(1.0, *rest) for rest in itertools.product((1.0, -1.0), repeat=count - 1)])
    right = np.zeros((len(rows), len(signs)))
    right[: 2 * count] = (smears[used[:count], :, None] * signs.T[:, None, :]).reshape(
        2 * count, -1
    )
    changes, *_ = np.linalg.lstsq(rows, right, rcond=None)
    misfit = np.sum((rows @ changes - right) ** 2, axis=0)
    return np.asarray(changes[:, int(np.argmin(misfit))])
