"""One image in, the limb out: the tracker without ROS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.camera import CameraError, CameraPose, Intrinsics
from apriltag_tracker.detection import Detector, Tag
from apriltag_tracker.detection.tracking import TagTracker
from apriltag_tracker.pose.following import LimbFollower, survey_errors
from apriltag_tracker.pose.shape import FollowerOptions, LimbEstimate, PlanarTag, centreline_pose
from apriltag_tracker.pose.world import WorldPose, locate
from apriltag_tracker.tag_map import TagMap

_SIZE_MEMORY = 20
"""Pictures over which the size of the limb's tags is averaged."""
_LARGEST_MISFIT = 0.06
"""RMS distance of a tag's corners from a square of its size [m, as a share of the size] above which
it is not at the height it should be at."""


@dataclass(frozen=True)
class PlacedTag:
    """A tag with its planar pose x, y [m], yaw [rad]; None without a camera pose."""

    tag: Tag
    on_limb: bool
    pose: NDArray[np.float64] | None


@dataclass(frozen=True)
class LimbObservation:
    """What one image says about the limb.

    Attributes:
        tags: all tags of the map that were seen.
        estimate: the limb; None if it cannot be told.
        reason: why there is no estimate, or what was bridged or left out.
        bridged: the estimate continues earlier motion; nothing of the limb was seen.
    """

    tags: tuple[PlacedTag, ...]
    estimate: LimbEstimate | None
    reason: str
    bridged: bool = False


class LimbTracker:
    """Follows a limb through a sequence of images.

    Args:
        tags: the tag map.
        intrinsics: of the camera.
        options: how it works.
        detector: finds the tags, of the map's family.
    """

    def __init__(
        self,
        tags: TagMap,
        intrinsics: Intrinsics,
        options: FollowerOptions | None = None,
        detector: Detector | None = None,
    ) -> None:
        self.tags = tags
        self.intrinsics = intrinsics
        self.options = options or FollowerOptions()
        self._limb_tags = {tag.id: tag for tag in tags.limb}
        self._flat = {tag.id: (tag.height, tag.size) for tag in tags.limb}
        self._flat.update({tag.id: (tag.position[2], tag.size) for tag in tags.world})
        self._world_positions = np.array([tag.position[:2] for tag in tags.world]).reshape(-1, 2)
        self._world_size = max((tag.size for tag in tags.world), default=1.0)
        self.tracker = TagTracker(self._flat, detector or Detector(family=tags.family))
        self.world = WorldPose(tags, intrinsics)
        self.follower = LimbFollower(tags, self.options)
        self.size_error = 0.0
        """Share by which limb tags look larger or smaller than the tag map says, all alike."""

    def observe(self, gray: NDArray[np.uint8], stamp: float) -> LimbObservation:
        """Find the limb in one image.

        Args:
            gray: image (rows, columns) of uint8.
            stamp: when it was taken [s].

        Raises:
            CameraError: the image has another size than the calibration.
        """
        size = self.intrinsics
        if gray.shape[:2] != (size.height, size.width):
            raise CameraError(
                f"the image has {gray.shape[1]} x {gray.shape[0]} px but the calibration is for "
                f"{size.width} x {size.height}: calibrate at the resolution that is used"
            )
        found = self.tracker.track(gray, stamp)
        pose = self.world.update(found)
        if pose is None:
            placed = tuple(PlacedTag(tag, tag.id in self._limb_tags, None) for tag in found)
            return LimbObservation(placed, None, f"no camera pose: {self.world.problem}")
        if not found:
            return LimbObservation((), *self.follower.follow([], stamp))
        return self._place(found, pose, stamp)

    def _place(self, found: Sequence[Tag], pose: CameraPose, stamp: float) -> LimbObservation:
        """Place all tags on their planes, and follow the limb by its own."""
        flat = np.array([self._flat[tag.id] for tag in found])
        places, spreads, misfits, moves = locate(
            np.array([tag.corners for tag in found]),
            np.array([tag.covariance for tag in found]),
            flat[:, 0],
            flat[:, 1],
            self.intrinsics,
            pose,
        )
        limb = [i for i, tag in enumerate(found) if tag.id in self._limb_tags]
        if limb:
            # Corners of a square that is too large are off by this share of half its diagonal.
            share = np.sqrt(2.0) * float(np.median(misfits[limb] / flat[limb, 1]))
            self.size_error += (share - self.size_error) / _SIZE_MEMORY
        used = [i for i in limb if misfits[i] <= _LARGEST_MISFIT * flat[i, 1]]
        planar = []
        for i in used:
            entry = self._limb_tags[found[i].id]
            centre = centreline_pose(places[i], entry.offset)
            planar.append(PlanarTag(entry.id, entry.arc_length, centre, spreads[i]))
        common = self._common_errors(places[used], flat[used, 0], pose)
        placed = tuple(
            PlacedTag(tag, tag.id in self._limb_tags, place)
            for tag, place in zip(found, places, strict=True)
        )
        root = np.linalg.cholesky(self.world.covariance + 1e-18 * np.eye(6))
        unfit = len(limb) - len(used)
        followed = self.follower.follow(planar, stamp, common, moves[used] @ root, unfit)
        return LimbObservation(placed, *followed)

    def _common_errors(
        self, places: NDArray[np.float64], heights: NDArray[np.float64], pose: CameraPose
    ) -> NDArray[np.float64]:
        """Return how tags move with errors that all of them share, (n, 3, 4).

        These are the survey's shift in x and y and its turn, which average over the fixed tags, and
        the height, which moves a tag away from the point below the camera.
        """
        uncertainty, origin = self.options.uncertainty, pose.position
        # One fixed tag alone says where the base turns to by its own corners only.
        surveyed = survey_errors(
            places, self._world_positions, uncertainty.survey, self._world_size
        )
        outward = (places[:, :2] - origin[:2]) / (heights - origin[2])[:, None]
        raised = uncertainty.height * np.column_stack([outward, np.zeros(len(places))])
        return np.concatenate([surveyed, raised[:, :, None]], axis=2)
