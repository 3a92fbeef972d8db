"""One image in, the limb out: the tracker without ROS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.camera import CameraPose, Intrinsics
from apriltag_tracker.detection import Detector, Tag
from apriltag_tracker.detection.tracking import FULL_SEARCH_PERIOD, TagTracker
from apriltag_tracker.pose.plane import centreline_pose, locate, pose_moves
from apriltag_tracker.pose.shape import LimbEstimate, PlanarTag, ShapeFitter, ShapePrior
from apriltag_tracker.pose.world import WorldPose
from apriltag_tracker.tag_map import LimbTag, TagMap, WorldTag


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
        largest_misfit: RMS distance of a tag's corners from a square of its size [m, as a share of
            the size] above which it is not at the height it should be at.
        uncertainty: what averaging does not remove.
        largest_tip_sigma: standard deviation of the tip, noise and systematic together, above which
            it is not told [m].
        prior: how the limb may differ from ideal.
        full_search_period: s between searches of the whole image while all tags are tracked; 0
            searches every image in full.
    """

    bridge_frames: int = 5
    reject_beyond: float = 0.004
    largest_misfit: float = 0.06
    largest_tip_sigma: float = 0.01
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    prior: ShapePrior = field(default_factory=ShapePrior)
    full_search_period: float = FULL_SEARCH_PERIOD


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
        self._limb_tags = {tag.id: tag for tag in tags.limb}
        self._flat = {tag.id: (tag.height, tag.size) for tag in tags.limb}
        self._flat.update({tag.id: (tag.position[2], tag.size) for tag in tags.world})
        self._world_positions = np.array([tag.position[:2] for tag in tags.world]).reshape(-1, 2)
        self._world_size = max((tag.size for tag in tags.world), default=1.0)
        detector = detector or Detector(family=tags.family)
        if detector.family != tags.family:
            raise ValueError(
                f"the detector reads {detector.family.name} but the tag map is of "
                f"{tags.family.name}: make it by Detector(family=tag_map.family)"
            )
        self.tracker = TagTracker(self._flat, detector, self.options.full_search_period)
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

    def observe(
        self, gray: NDArray[np.uint8], stamp: float, search_later: bool = False
    ) -> LimbObservation:
        """Find the limb in one image.

        Args:
            gray: image (rows, columns) of uint8.
            stamp: when it was taken [s].
            search_later: leave what cannot change the answer to `search_again`.

        Raises:
            ValueError: the image is none, or has another size than the calibration.
        """
        size = self.intrinsics
        if gray.shape[:2] != (size.height, size.width):
            raise ValueError(
                f"the image has {gray.shape[1]} x {gray.shape[0]} px but the calibration is for "
                f"{size.width} x {size.height}: calibrate at the resolution that is used"
            )
        found = self.tracker.track(gray, stamp, search_later)
        pose = self.world.update(found)
        placed, planar, common, shared_noise = self._place(found, pose)
        if pose is None:
            return LimbObservation(placed, None, f"no camera pose: {self.world.problem}")
        estimate = self.fitter.fit(planar, common, shared_noise) if planar else None
        if estimate is None:
            return self._bridge(placed, stamp, bool(planar))
        self.misplaced += len(estimate.rejected)
        sigma = estimate.tip_sigma
        if sigma > self.options.largest_tip_sigma:
            self._history.clear()
            reason = f"the tip is known to {1e3 * sigma:.0f} mm only; {self._remark(estimate)}"
            return LimbObservation(placed, None, reason)
        self._bridged = 0
        if self._history and stamp <= self._history[-1][0]:
            self._history.clear()
        self._history = [*self._history[-1:], (stamp, estimate)]
        return LimbObservation(placed, estimate, self._remark(estimate))

    def search_again(self, gray: NDArray[np.uint8]) -> None:
        """Look for duplicates and unknown tags in the last image, if that was left for later."""
        self.tracker.search_again(gray)

    def _place(
        self, found: Sequence[Tag], pose: CameraPose | None
    ) -> tuple[tuple[PlacedTag, ...], list[PlanarTag], NDArray[np.float64], NDArray[np.float64]]:
        """Place all tags on their planes; those of the limb also with shared errors and noise."""
        if pose is None or not found:
            placed = tuple(PlacedTag(tag, tag.id in self._limb_tags, None) for tag in found)
            return placed, [], np.empty((0, 3, 0)), np.empty((0, 3, 0))
        flat = np.array([self._flat[tag.id] for tag in found])
        places, spreads, misfits = locate(
            np.array([tag.corners for tag in found]),
            np.array([tag.covariance for tag in found]),
            flat[:, 0],
            flat[:, 1],
            self.intrinsics,
            pose,
        )
        used = [
            i
            for i, tag in enumerate(found)
            if tag.id in self._limb_tags and misfits[i] <= self.options.largest_misfit * flat[i, 1]
        ]
        planar = []
        for i in used:
            entry = self._limb_tags[found[i].id]
            centre = centreline_pose(places[i], entry)
            planar.append(PlanarTag(entry.id, entry.arc_length, centre, spreads[i]))
        common = self._common_errors(places[used], flat[used, 0], pose)
        everywhere = tuple(
            PlacedTag(tag, tag.id in self._limb_tags, place)
            for tag, place in zip(found, places, strict=True)
        )
        noise = pose_moves(places[used], flat[used, 0], flat[used, 1], pose)
        root = np.linalg.cholesky(self.world.covariance + 1e-18 * np.eye(6))
        return everywhere, planar, common, noise @ root

    def _common_errors(
        self, places: NDArray[np.float64], heights: NDArray[np.float64], pose: CameraPose
    ) -> NDArray[np.float64]:
        """Return how tags move with errors that all of them share, (n, 3, 4).

        These are the survey's shift in x and y and its turn, which average over the fixed tags, and
        the height, which moves a tag away from the point below the camera.
        """
        uncertainty = self.options.uncertainty
        shift = uncertainty.survey / math.sqrt(len(self._world_positions))
        middle = self._world_positions.mean(axis=0)
        spread = math.sqrt(float(np.sum((self._world_positions - middle) ** 2)))
        # One fixed tag alone says where the base turns to by its own corners only.
        turn = uncertainty.survey / max(spread, self._world_size)
        arm = places[:, :2] - middle
        origin = pose.position
        moves = np.zeros((len(places), 3, 4))
        moves[:, 0, 0] = moves[:, 1, 1] = shift
        moves[:, 0, 2], moves[:, 1, 2], moves[:, 2, 2] = -turn * arm[:, 1], turn * arm[:, 0], turn
        outward = (places[:, :2] - origin[:2]) / (heights - origin[2])[:, None]
        moves[:, :2, 3] = uncertainty.height * outward
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


def warm_up(detector: Detector) -> None:
    """Follow a tiny still limb through two images, so that no kernel is compiled in a run."""
    family, f = detector.family, 500.0
    side = 5 * family.border_cells
    # 125 mm above the plane, a pixel is a quarter of a millimetre.
    size = 0.00025 * side
    limb, world = (LimbTag(0, 0.01, 0.0, size),), (WorldTag(1, (0.03, 0.0, 0.0), 0.0, size),)
    tags = TagMap((0.02,), limb, world, family=family)
    image = np.full((120, 240), 255, dtype=np.uint8)
    for tag, left in ((0, 40), (1, 120)):
        family.draw_tag(image, tag, 5, left, 40)
    matrix = [f, 0.0, 59.5, 0.0, f, 59.5, 0.0, 0.0, 1.0]
    tracker = LimbTracker(tags, Intrinsics.create(240, 120, matrix, []), detector=detector)
    for stamp in (0.0, 0.03):
        observation = tracker.observe(image, stamp)
    if observation.estimate is None:
        raise RuntimeError(f"the tracker does not work here: {observation.reason}")
