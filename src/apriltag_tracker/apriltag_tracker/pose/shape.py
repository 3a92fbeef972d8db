"""From tags on the plane to the limb: tip, curve, bend angles, and how sure they are.

The limb's heading is θ(s) = θ0 + ∫κ ds with one constant curvature a segment and smooth corrections
(Legendre polynomials of the segment's coordinate) that a prior keeps small. Positions follow from
integrating the tangent, stretched by one elongation. All unknowns come from one weighted
least-squares fit of the tags' positions and headings (maximum a posteriori, Gauss-Newton).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.pose.curve import PLACE, Curve, CurveFit, Evaluation, fit_curve
from apriltag_tracker.tag_map import LimbGeometry


@dataclass(frozen=True)
class PlanarTag:
    """A tag of the limb on the plane.

    Attributes:
        id: of the tag.
        arc_length: where on the limb its centre is [m].
        pose: (3,) x, y [m] and heading [rad] of the centreline there, mounting offsets taken off.
        covariance: (3, 3) repeatability, from the noise of its corners.
    """

    id: int
    arc_length: float
    pose: NDArray[np.float64]
    covariance: NDArray[np.float64]


@dataclass(frozen=True)
class ShapePrior:
    """How far the limb may be from an unstretched, constant-curvature limb clamped at the base.

    Attributes:
        base_position: standard deviation of the clamp's position [m].
        base_heading: standard deviation of its direction [rad].
        elongation: standard deviation of length over rest length.
        curvature: standard deviation of a segment's mean curvature [1/m].
        corrections: standard deviations of the Legendre terms of degree 1, 2, … of a segment's
            curvature [1/m].
        tag_position: what a tag's position may be off besides noise, e.g. by its mounting [m].
        tag_heading: the same of its heading [rad].
        arc_position: how far a real limb's points are from arcs of constant curvature [m].
        arc_heading: the same of its heading [rad].
    """

    base_position: float = 0.0005
    base_heading: float = 0.005
    elongation: float = 0.03
    curvature: float = 12.0
    corrections: tuple[float, ...] = (2.0, 1.5, 1.0, 0.7)
    tag_position: float = 5e-5
    tag_heading: float = 3e-3
    arc_position: float = 5e-4
    arc_heading: float = 5e-3


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations of what averaging does not remove.

    Attributes:
        survey: of the positions of fixed tags or bodies [m].
        height: of the limb tags' heights [m].
        mounting: of the positions of tags or bodies on the limb [m].
        mounting_angle: of their directions [rad].
    """

    survey: float = 3e-4
    height: float = 5e-4
    mounting: float = 2e-4
    mounting_angle: float = 5e-3


@dataclass(frozen=True)
class FollowerOptions:
    """How the limb is followed.

    Attributes:
        bridge_frames: frames without a tip that are bridged from the motion before.
        reject_beyond: distance from the others' shape at which one is on the wrong place [m].
        largest_tip_sigma: standard deviation of the tip, noise and systematic together, above which
            it is not told [m].
        uncertainty: what averaging does not remove.
        prior: how the limb may differ from ideal.
    """

    bridge_frames: int = 5
    reject_beyond: float = 0.004
    largest_tip_sigma: float = 0.01
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    prior: ShapePrior = field(default_factory=ShapePrior)


@dataclass(frozen=True)
class LimbEstimate:
    """The limb in one image.

    Attributes:
        tip: (2,) m.
        tip_covariance: (2, 2) m², noise of this image's corners and of the camera's pose.
        tip_systematic: (2, 2) m², what averaging does not remove: survey, height, mounting.
        bend_angle: (M,) rad, heading at the end of each segment less that at its start, of the
            smooth fit: a limb with stiff fittings is no arc, arcs would mix the segments' bends.
        bend_angle_sigma: (M,) rad.
        curvature: (M,) 1/m, of the parts of each segment that bend, by constant curvature.
        elongation: length over length at rest.
        residual: RMS distance of the tags from the constant-curvature shape [m].
        curve: (n, 2) m, base to tip.
        tags_used: ids of the tags the fit kept.
        rejected: ids of tags that cannot be where they were seen, with their distance [m].
    """

    tip: NDArray[np.float64]
    tip_covariance: NDArray[np.float64]
    tip_systematic: NDArray[np.float64]
    bend_angle: NDArray[np.float64]
    bend_angle_sigma: NDArray[np.float64]
    curvature: NDArray[np.float64]
    elongation: float
    residual: float
    curve: NDArray[np.float64]
    tags_used: tuple[int, ...]
    rejected: dict[int, float] = field(default_factory=dict)

    @property
    def tip_sigma(self) -> float:
        """Standard deviation of the tip in its least certain direction, of both parts [m]."""
        return float(np.sqrt(np.linalg.eigvalsh(self.tip_covariance + self.tip_systematic)[-1]))


def centreline_pose(
    place: NDArray[np.float64], offset: tuple[float, float, float]
) -> NDArray[np.float64]:
    """Take a mounting offset off a pose in the plane: the centreline's pose where it sits, (3,).

    Args:
        place: (3,) x, y [m], heading [rad] of a tag or body.
        offset: of it along and across the limb [m] and of its direction [rad].
    """
    along, across, turn = offset
    heading = place[2] - turn
    cosine, sine = np.cos(heading), np.sin(heading)
    return np.array(
        [
            place[0] - cosine * along + sine * across,
            place[1] - sine * along - cosine * across,
            heading,
        ]
    )


def _carried(gain: NDArray[np.float64], spreads: NDArray[np.float64]) -> NDArray[np.float64]:
    """Carry independent covariances (n, 3, 3), or one for all (3, 3), through a gain (m, n, 3)."""
    by_tag = gain.transpose(1, 0, 2)
    return np.asarray((by_tag @ spreads @ by_tag.transpose(0, 2, 1)).sum(axis=0))


def _furthest(fit: CurveFit) -> float:
    """Return the largest distance of a tag from the fit [m]."""
    return float(np.hypot(fit.residuals[:, 0], fit.residuals[:, 1]).max())


CURVE_POINTS = 41
"""Points of the published curve."""
_HOPELESS = 5.0
"""Residual over the distance of rejection above which nothing can be said."""


class ShapeFitter:
    """Fits the limb to its tags.

    Args:
        geometry: of the limb.
        options: how it works.
    """

    def __init__(self, geometry: LimbGeometry, options: FollowerOptions | None = None) -> None:
        options = options or FollowerOptions()
        self._prior = options.prior
        self._reject_beyond = options.reject_beyond
        mounting, angle = options.uncertainty.mounting, options.uncertainty.mounting_angle
        self._mounted = np.diag([mounting, mounting, angle]) ** 2
        self._smooth = Curve(geometry.segment_lengths, len(self._prior.corrections), geometry.stiff)
        self._constant = Curve(geometry.segment_lengths, 0, geometry.stiff)
        self._outline = Evaluation(
            self._smooth, np.linspace(0.0, geometry.length, CURVE_POINTS).tolist()
        )
        self._evaluation = functools.lru_cache(maxsize=200)(Evaluation)
        self._last = np.zeros(self._smooth.size)

    def reset(self) -> None:
        """Forget the last shape, from which the next fit would start."""
        self._last = np.zeros(self._smooth.size)

    def fit(
        self,
        tags: Sequence[PlanarTag],
        common: NDArray[np.float64] | None = None,
        shared_noise: NDArray[np.float64] | None = None,
    ) -> LimbEstimate | None:
        """Fit the limb to the tags of one image.

        Args:
            tags: of the limb, each id once.
            common: (n, 3, k) how the tags' poses move with k systematic errors of one standard
                deviation each (survey, heights), in the order of the tags.
            shared_noise: (n, 3, k) the same for noise that all tags share, of the camera's pose.

        Returns:
            The estimate, or None if no tag, or no consistent set of tags, was left.
        """
        kept, rejected, arcs = self._consistent(list(tags))
        if arcs is None:
            return None
        fit = self._solve(self._smooth, kept)
        self._last = fit.parameters
        order = [i for i, tag in enumerate(tags) if tag.id not in rejected]
        none = np.zeros((len(tags), PLACE, 1))
        common, shared_noise = (none if m is None else m for m in (common, shared_noise))
        return self._estimate(fit, arcs, kept, rejected, common[order], shared_noise[order])

    def _consistent(
        self, tags: list[PlanarTag]
    ) -> tuple[list[PlanarTag], dict[int, float], CurveFit | None]:
        """Leave out tags that are far from the arcs through all others.

        Arcs are stiff enough to show a tag on the wrong place, which the smooth fit would follow.

        Returns:
            The tags that are left; those left out with their distance; and the fit of arcs to what
            is left, None if that is less than half or still contradicts itself.
        """
        kept, rejected = list(tags), {}
        while kept:
            arcs = self._solve(self._constant, kept)
            furthest = _furthest(arcs)
            if furthest < 0.5 * self._reject_beyond or len(kept) < 3:
                break
            outside, distance, rest = self._odd_one_out(kept)
            if distance < self._reject_beyond or rest > 0.5 * furthest:
                break
            rejected[kept[outside].id] = distance
            del kept[outside]
        if len(kept) <= len(tags) // 2 or furthest > _HOPELESS * self._reject_beyond:
            return kept, rejected, None
        return kept, rejected, arcs

    def _odd_one_out(self, tags: Sequence[PlanarTag]) -> tuple[int, float, float]:
        """Find the tag without which the others agree best.

        Returns:
            Its index, its distance from the arcs through the others, and the largest residual of
            these others [m].
        """
        fits = [self._solve(self._constant, [*tags[:i], *tags[i + 1 :]]) for i in range(len(tags))]
        rest = [_furthest(fit) for fit in fits]
        outside = int(np.argmin(rest))
        tag = tags[outside]
        place, _ = self._evaluation(self._constant, (tag.arc_length,)).places(
            fits[outside].parameters
        )
        return outside, float(np.hypot(*(place[0, :2] - tag.pose[:2]))), rest[outside]

    def _prior_sigma(self, curve: Curve) -> NDArray[np.float64]:
        prior = self._prior
        base = [prior.base_position, prior.base_position, prior.base_heading, prior.elongation]
        mean = [prior.curvature] * curve.segments
        return np.array(base + mean + list(prior.corrections[: curve.degrees]) * curve.segments)

    def _solve(self, curve: Curve, tags: Sequence[PlanarTag]) -> CurveFit:
        """Find the most probable parameters and the gain (size, n, 3) from measurements to them."""
        evaluation = self._evaluation(curve, tuple(tag.arc_length for tag in tags))
        prior = self._prior
        position, heading = prior.arc_position, prior.arc_heading
        if curve.degrees:
            position, heading = prior.tag_position, prior.tag_heading
        covariances = np.array([tag.covariance for tag in tags])
        return fit_curve(
            evaluation,
            np.array([tag.pose for tag in tags]),
            covariances + np.diag([position, position, heading]) ** 2,
            self._prior_sigma(curve),
            self._last[: curve.size],
        )

    def _estimate(
        self,
        fit: CurveFit,
        arcs: CurveFit,
        tags: Sequence[PlanarTag],
        rejected: dict[int, float],
        common: NDArray[np.float64],
        shared_noise: NDArray[np.float64],
    ) -> LimbEstimate:
        curve, slopes = self._outline.places(fit.parameters)
        spreads = np.array([tag.covariance for tag in tags])
        tip_gain = np.tensordot(slopes[-1, :2], fit.gain, 1)
        noise = _carried(tip_gain, spreads)
        systematic = _carried(tip_gain, self._mounted)
        shared = np.tensordot(tip_gain, common, 2)
        systematic += shared @ shared.T
        shared = np.tensordot(tip_gain, shared_noise, 2)
        noise += shared @ shared.T
        # What the tags do not determine, the prior leaves open.
        undetermined = slopes[-1, :2] @ fit.left_open
        systematic += undetermined @ undetermined.T
        # A tip that may be far to the side is also nearer: the second order of a long arc.
        systematic += (np.sum(undetermined**2) / self._smooth.ends[-1]) ** 2 * np.eye(2)
        # The corrections of a segment integrate to nothing: its mean curvature is its bend.
        means = slice(4, 4 + self._smooth.segments)
        bending = self._smooth.active
        bend_gain = fit.gain[means]
        variance = np.diag(_carried(bend_gain, spreads + self._mounted))
        variance = variance + np.sum(fit.left_open[means] ** 2, axis=1)
        return LimbEstimate(
            tip=curve[-1, :2],
            tip_covariance=noise,
            tip_systematic=systematic,
            bend_angle=fit.parameters[means] * bending,
            bend_angle_sigma=np.sqrt(variance) * bending,
            curvature=arcs.parameters[4:],
            elongation=1.0 + float(fit.parameters[3]),
            residual=float(np.sqrt(np.mean(np.sum(arcs.residuals[:, :2] ** 2, axis=1)))),
            curve=curve[:, :2],
            tags_used=tuple(tag.id for tag in tags),
            rejected=rejected,
        )
