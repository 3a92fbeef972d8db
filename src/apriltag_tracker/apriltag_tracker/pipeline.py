"""One image in, the limb out: the tracker without ROS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.camera import CameraPose, Intrinsics
from apriltag_tracker.detection import Detector, Tag
from apriltag_tracker.plane import centreline_pose, height_slope, locate
from apriltag_tracker.shape import LimbEstimate, PlanarTag, ShapeFitter, ShapePrior
from apriltag_tracker.tag_map import TagMap
from apriltag_tracker.tracking import TagTracker, TrackingOptions
from apriltag_tracker.world import WorldPose


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations of what averaging does not remove.

    Attributes:
        survey: of the fixed tags' positions [m].
        height: of the limb tags' heights [m].
        mounting: of the limb tags' positions on the limb [m].
        mounting_angle: of their directions [rad].
    """

    survey: float = 3e-4
    height: float = 5e-4
    mounting: float = 2e-4
    mounting_angle: float = 5e-3


@dataclass(frozen=True)
class TrackerOptions:
    """How the tracker works.

    Attributes:
        bridge_frames: frames without a tip that are bridged from the motion before.
        reject_beyond: distance from the other tags' shape at which a tag is on the wrong place [m].
        largest_misfit: RMS distance of a tag's corners from a square of its size [m, as a share of the
            size] above which it is not at the height it should be at.
        uncertainty: what averaging does not remove.
        prior: how the limb may differ from ideal.
        tracking: when to search how.
    """

    bridge_frames: int = 5
    reject_beyond: float = 0.004
    largest_misfit: float = 0.06
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    prior: ShapePrior = field(default_factory=ShapePrior)
    tracking: TrackingOptions = field(default_factory=TrackingOptions)


@dataclass(frozen=True)
class PlacedTag:
    """A tag with its planar pose: x, y [m], yaw [rad] in `limb_base`; None without a camera pose."""

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
        detector: finds the tags.
    """

    def __init__(
        self,
        tags: TagMap,
        intrinsics: Intrinsics,
        options: TrackerOptions | None = None,
        detector: Detector | None = None,
    ) -> None:
        self.tags = tags
        self.intrinsics = intrinsics
        self.options = options or TrackerOptions()
        wanted = [tag.id for tag in (*tags.limb, *tags.world)]
        self.tracker = TagTracker(wanted, detector, self.options.tracking)
        self.world = WorldPose(tags, intrinsics)
        uncertainty = self.options.uncertainty
        self.fitter = ShapeFitter(
            tags,
            self.options.prior,
            self.options.reject_beyond,
            uncertainty.mounting,
            uncertainty.mounting_angle,
        )
        self._history: list[tuple[float, LimbEstimate]] = []
        self._bridged = 0
        self.misplaced = 0
        """Tags left out so far because they were on the wrong place."""

    def observe(self, gray: NDArray[np.uint8], stamp: float) -> LimbObservation:
        """Find the limb in one image.

        Args:
            gray: image (rows, columns) of uint8.
            stamp: when it was taken [s].

        Raises:
            ValueError: the image is none, or has another size than the calibration.
        """
        size = self.intrinsics
        if gray.shape[:2] != (size.height, size.width):
            raise ValueError(
                f"the image has {gray.shape[1]} x {gray.shape[0]} px but the calibration is for "
                f"{size.width} x {size.height}: calibrate at the resolution that is used"
            )
        found = self.tracker.track(gray, stamp)
        pose = self.world.update(found)
        placed, planar, common = self._place(found, pose)
        if pose is None:
            return LimbObservation(placed, None, f"no camera pose: {self.world.problem}")
        estimate = self.fitter.fit(planar, common) if planar else None
        if estimate is None:
            return self._bridge(placed, stamp, bool(planar))
        self._bridged = 0
        self.misplaced += len(estimate.rejected)
        if self._history and stamp <= self._history[-1][0]:
            self._history.clear()
        self._history = [*self._history[-1:], (stamp, estimate)]
        return LimbObservation(placed, estimate, self._remark(estimate))

    def _place(
        self, found: Sequence[Tag], pose: CameraPose | None
    ) -> tuple[tuple[PlacedTag, ...], list[PlanarTag], NDArray[np.float64]]:
        placed: list[PlacedTag] = []
        planar: list[PlanarTag] = []
        common: list[NDArray[np.float64]] = []
        for tag in found:
            entry = self.tags.limb_tag(tag.id)
            world = self.tags.world_tag(tag.id)
            on_limb = entry is not None
            if pose is None or (entry is None and world is None):
                placed.append(PlacedTag(tag, on_limb, None))
                continue
            height = entry.height if entry is not None else world.position[2] if world else 0.0
            size = entry.size if entry is not None else world.size if world else 0.0
            place, covariance, misfit = locate(tag, height, size, self.intrinsics, pose)
            placed.append(PlacedTag(tag, on_limb, place))
            if entry is None or misfit > self.options.largest_misfit * size:
                continue
            centre = centreline_pose(place, entry)
            planar.append(PlanarTag(tag.id, entry.arc_length, centre, covariance))
            common.append(self._common_errors(place, height, pose))
        stacked = np.array(common) if common else np.empty((0, 3, 0))
        return tuple(placed), planar, stacked

    def _common_errors(
        self, place: NDArray[np.float64], height: float, pose: CameraPose
    ) -> NDArray[np.float64]:
        """Return how one tag moves with errors that all tags share, (3, 4): survey x, y, turn; height.

        The survey's errors average over the fixed tags; its turn is seen from their middle.
        """
        uncertainty = self.options.uncertainty
        positions = np.array([tag.position[:2] for tag in self.tags.world])
        middle = positions.mean(axis=0)
        spread = np.sqrt(np.sum((positions - middle) ** 2)) or 1.0
        shift = uncertainty.survey / np.sqrt(len(positions))
        turn = uncertainty.survey / spread
        arm = place[:2] - middle
        moves = np.zeros((3, 4))
        moves[0, 0] = moves[1, 1] = shift
        moves[:, 2] = turn * np.array([-arm[1], arm[0], 1.0])
        moves[:, 3] = uncertainty.height * height_slope(place, height, pose)
        return moves

    def _remark(self, estimate: LimbEstimate) -> str:
        parts = []
        if estimate.rejected:
            wrong = ", ".join(
                f"{tag} ({1e3 * distance:.0f} mm off)"
                for tag, distance in estimate.rejected.items()
            )
            parts.append(f"tag on the wrong place, left out: {wrong}")
        unseen = [
            str(tag.id)
            for tag in self.tags.limb
            if tag.id not in estimate.tags_used and tag.id not in estimate.rejected
        ]
        if unseen:
            parts.append(f"without tag {', '.join(unseen)}")
        return "; ".join(parts)

    def _bridge(
        self, placed: tuple[PlacedTag, ...], stamp: float, inconsistent: bool
    ) -> LimbObservation:
        """Continue the last motion for a few frames, with a covariance that grows."""
        cause = (
            "the limb's tags contradict each other" if inconsistent else "no limb tag in the image"
        )
        self._bridged += 1
        if self._bridged > self.options.bridge_frames or len(self._history) < 2:
            self._history.clear()
            self.fitter.reset()
            return LimbObservation(placed, None, cause)
        (before, old), (last, new) = self._history
        share = (stamp - last) / (last - before)
        # How wrong the continuation can be: as far as the limb went meanwhile, and a millimetre.
        slip = (new.tip - old.tip) * share
        growth = np.outer(slip, slip) + 1e-6 * np.eye(2)
        estimate = LimbEstimate(
            tip=new.tip + slip,
            tip_covariance=new.tip_covariance + growth,
            tip_systematic=new.tip_systematic,
            tip_heading=new.tip_heading + (new.tip_heading - old.tip_heading) * share,
            bend_angle=new.bend_angle + (new.bend_angle - old.bend_angle) * share,
            bend_angle_sigma=new.bend_angle_sigma
            + np.abs(new.bend_angle - old.bend_angle) * share
            + 0.01,
            curvature=new.curvature + (new.curvature - old.curvature) * share,
            elongation=new.elongation,
            residual=new.residual,
            curve=new.curve + (new.curve - old.curve) * share,
            tags_used=(),
        )
        frames = "frame" if self._bridged == 1 else "frames"
        remark = f"bridged {self._bridged} {frames}: {cause}"
        return LimbObservation(placed, estimate, remark, bridged=True)
