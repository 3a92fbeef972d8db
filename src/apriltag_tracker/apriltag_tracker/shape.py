"""From tags on the plane to the limb: tip, curve, bend angles, and how sure they are.

The limb's heading is θ(s) = θ0 + ∫κ ds with one constant curvature a segment and smooth corrections
(Legendre polynomials of the segment's coordinate) that a prior keeps small. Positions follow from
integrating the tangent, stretched by one elongation. All unknowns come from one weighted least-
squares fit of the tags' positions and headings (maximum a posteriori, Gauss-Newton).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.tag_map import TagMap

PLACE = 3
"""Numbers of a planar pose: x, y [m], heading [rad]."""


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
class LimbEstimate:
    """The limb in one image.

    Attributes:
        tip: (2,) m.
        tip_covariance: (2, 2) m², repeatability.
        tip_systematic: (2, 2) m², what averaging does not remove: survey, height, mounting.
        tip_heading: [rad].
        bend_angle: (M,) rad, by constant curvature.
        bend_angle_sigma: (M,) rad.
        curvature: (M,) 1/m, of the parts of each segment that bend.
        elongation: length over length at rest.
        residual: RMS distance of the tags from the constant-curvature shape [m].
        curve: (n, 2) m, base to tip.
        tags_used: ids of the tags the fit kept.
        rejected: ids of tags that cannot be where they were seen, with their distance [m].
    """

    tip: NDArray[np.float64]
    tip_covariance: NDArray[np.float64]
    tip_systematic: NDArray[np.float64]
    tip_heading: float
    bend_angle: NDArray[np.float64]
    bend_angle_sigma: NDArray[np.float64]
    curvature: NDArray[np.float64]
    elongation: float
    residual: float
    curve: NDArray[np.float64]
    tags_used: tuple[int, ...]
    rejected: dict[int, float] = field(default_factory=dict)


class _Curve:
    """A family of curves: heading linear in the parameters, evaluated at fixed arc lengths.

    Parameters are x0, y0, θ0, elongation − 1, one curvature a segment, then the corrections. Stiff
    stretches keep their heading.
    """

    def __init__(
        self,
        lengths: Sequence[float],
        degrees: int,
        stiff: Sequence[tuple[float, float]] = (),
        grid: int = 20,
    ) -> None:
        ends = np.concatenate([[0.0], np.cumsum(lengths)])
        self.ends = ends
        self.segments = len(lengths)
        self.degrees = degrees
        self.size = 4 + self.segments * (1 + degrees)
        nodes, weights = np.polynomial.legendre.leggauss(4)
        self._stiff = tuple(stiff)
        self.active = np.diff(self._bending_length(ends))
        edges = np.unique(
            np.concatenate(
                [np.linspace(a, b, grid + 1) for a, b in itertools.pairwise(ends)]
                + [np.array(stretch) for stretch in self._stiff]
            )
        )
        self._edges = edges
        self._nodes = nodes
        self._weights = weights

    def _bending_length(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how much of the limb up to each arc length can bend [m]."""
        result = np.clip(s, 0.0, self.ends[-1])
        for start, end in self._stiff:
            result = result - (np.clip(s, start, end) - start)
        return result

    def heading_basis(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return dθ/dp at arc lengths (n,), (n, size)."""
        basis = np.zeros((len(s), self.size))
        basis[:, 2] = 1.0
        bending, starts = self._bending_length(s), self._bending_length(self.ends)
        for j in range(self.segments):
            half = 0.5 * self.active[j]
            local = np.clip((bending - starts[j]) / half - 1.0, -1.0, 1.0)
            basis[:, 4 + j] = half * (local + 1.0)
            for degree in range(1, self.degrees + 1):
                column = 4 + self.segments + j * self.degrees + degree - 1
                # Integral of the Legendre polynomial from -1.
                series = np.zeros(degree + 1)
                series[degree] = 1.0
                integral = np.polynomial.legendre.legint(series, lbnd=-1.0)
                basis[:, column] = half * np.polynomial.legendre.legval(local, integral)
        return basis

    def quadrature(self, s: Sequence[float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return Gauss points of the limb and weights (n, points) that integrate up to each s."""
        edges = np.unique(np.concatenate([self._edges, np.clip(s, 0.0, self.ends[-1])]))
        middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
        points = (middle[:, None] + half[:, None] * self._nodes).ravel()
        weights = (half[:, None] * self._weights).ravel()
        table = np.where(points[None, :] < np.asarray(s)[:, None], weights, 0.0)
        return points, table


class _Evaluation:
    """A curve at a fixed set of arc lengths: places and their derivatives."""

    def __init__(self, curve: _Curve, s: Sequence[float]) -> None:
        self.s = np.asarray(s, dtype=np.float64)
        points, self._integral = curve.quadrature(s)
        self._inner = curve.heading_basis(points)
        self._outer = curve.heading_basis(self.s)
        self._size = curve.size

    def places(
        self, parameters: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return x, y, heading (n, 3) and their derivatives (n, 3, size)."""
        heading = self._inner @ parameters
        stretch = 1.0 + parameters[3]
        cosine, sine = np.cos(heading), np.sin(heading)
        x, y = self._integral @ cosine, self._integral @ sine
        places = np.empty((len(self.s), PLACE))
        places[:, 0] = parameters[0] + stretch * x
        places[:, 1] = parameters[1] + stretch * y
        places[:, 2] = self._outer @ parameters
        jacobian = np.empty((len(self.s), PLACE, self._size))
        jacobian[:, 0] = -stretch * (self._integral @ (sine[:, None] * self._inner))
        jacobian[:, 1] = stretch * (self._integral @ (cosine[:, None] * self._inner))
        jacobian[:, 2] = self._outer
        jacobian[:, 0, 0] = 1.0
        jacobian[:, 1, 1] = 1.0
        jacobian[:, 0, 3] = x
        jacobian[:, 1, 3] = y
        return places, jacobian


def wrap(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles between −π and π."""
    result: NDArray[np.float64] = (angle + np.pi) % (2.0 * np.pi) - np.pi
    return result


@dataclass(frozen=True)
class _Fit:
    parameters: NDArray[np.float64]
    gain: NDArray[np.float64]
    residuals: NDArray[np.float64]
    left_open: NDArray[np.float64]


def _furthest(fit: _Fit) -> float:
    """Return the largest distance of a tag from the fit [m]."""
    return float(np.hypot(fit.residuals[:, 0], fit.residuals[:, 1]).max())


_HOPELESS = 5.0
"""Residual over the distance of rejection above which nothing can be said."""


class ShapeFitter:
    """Fits the limb to its tags.

    Args:
        tags: the tag map; gives lengths and which tags there are.
        prior: how the limb may differ from ideal.
        reject_beyond: distance from the fit of all others at which a tag is on the wrong place [m].
        mounting: standard deviation of the tags' mounting on the limb [m].
        mounting_angle: the same of their direction [rad].
        curve_points: points of the published curve.
    """

    def __init__(
        self,
        tags: TagMap,
        prior: ShapePrior | None = None,
        reject_beyond: float = 0.004,
        mounting: float = 2e-4,
        mounting_angle: float = 5e-3,
        curve_points: int = 41,
    ) -> None:
        self.prior = prior or ShapePrior()
        self.reject_beyond = reject_beyond
        self._mounting = np.array([mounting, mounting, mounting_angle])
        self._smooth = _Curve(tags.segment_lengths, len(self.prior.corrections), tags.stiff)
        self._constant = _Curve(tags.segment_lengths, 0, tags.stiff)
        self._outline = _Evaluation(
            self._smooth, np.linspace(0.0, tags.length, curve_points).tolist()
        )
        self._evaluations: dict[tuple[int, tuple[float, ...]], _Evaluation] = {}
        self._last = np.zeros(self._smooth.size)

    def reset(self) -> None:
        """Forget the last shape, from which the next fit would start."""
        self._last = np.zeros(self._smooth.size)

    def fit(
        self, tags: Sequence[PlanarTag], common: NDArray[np.float64] | None = None
    ) -> LimbEstimate | None:
        """Fit the limb to the tags of one image.

        Args:
            tags: of the limb, each id once.
            common: (n, 3, k) how the tags' poses move with k systematic errors of one standard
                deviation each (survey, heights), in the order of the tags.

        Returns:
            The estimate, or None if no tag, or no consistent set of tags, was left.
        """
        kept, rejected, arcs = self._consistent(list(tags))
        if arcs is None:
            return None
        fit = self._solve(self._smooth, kept, self._last)
        self._last = fit.parameters
        order = [i for i, tag in enumerate(tags) if tag.id not in rejected]
        shared = None if common is None else common[order]
        return self._estimate(fit, arcs, kept, rejected, shared)

    def _consistent(
        self, tags: list[PlanarTag]
    ) -> tuple[list[PlanarTag], dict[int, float], _Fit | None]:
        """Leave out tags that are far from the arcs through all others.

        Arcs are stiff enough to show a tag on the wrong place, which the smooth fit would follow.

        Returns:
            The tags that are left; those left out with their distance; and the fit of arcs to what
            is left, None if that is less than half or still contradicts itself.
        """
        kept, rejected = list(tags), {}
        while kept:
            arcs = self._solve(self._constant, kept, self._last)
            furthest = _furthest(arcs)
            if furthest < 0.5 * self.reject_beyond or len(kept) < 3:
                break
            outside, distance, rest = self._odd_one_out(kept)
            if distance < self.reject_beyond or rest > 0.5 * furthest:
                break
            rejected[kept[outside].id] = distance
            del kept[outside]
        if len(kept) <= len(tags) // 2 or furthest > _HOPELESS * self.reject_beyond:
            return kept, rejected, None
        return kept, rejected, arcs

    def _odd_one_out(self, tags: Sequence[PlanarTag]) -> tuple[int, float, float]:
        """Find the tag without which the others agree best.

        Returns:
            Its index, its distance from the arcs through the others, and the largest residual of
            these others [m].
        """
        fits = [
            self._solve(self._constant, [*tags[:i], *tags[i + 1 :]], self._last)
            for i in range(len(tags))
        ]
        rest = [_furthest(fit) for fit in fits]
        outside = int(np.argmin(rest))
        tag = tags[outside]
        place, _ = self._evaluation(self._constant, [tag]).places(fits[outside].parameters)
        return outside, float(np.hypot(*(place[0, :2] - tag.pose[:2]))), rest[outside]

    def _evaluation(self, curve: _Curve, tags: Sequence[PlanarTag]) -> _Evaluation:
        key = (curve.size, tuple(tag.arc_length for tag in tags))
        if key not in self._evaluations:
            if len(self._evaluations) > 200:
                self._evaluations.clear()
            self._evaluations[key] = _Evaluation(curve, key[1])
        return self._evaluations[key]

    def _prior_sigma(self, curve: _Curve) -> NDArray[np.float64]:
        prior = self.prior
        base = [prior.base_position, prior.base_position, prior.base_heading, prior.elongation]
        mean = [prior.curvature] * curve.segments
        return np.array(base + mean + list(prior.corrections[: curve.degrees]) * curve.segments)

    def _solve(self, curve: _Curve, tags: Sequence[PlanarTag], start: NDArray[np.float64]) -> _Fit:
        """Find the most probable parameters and the gain (size, n, 3) from measurements to them."""
        evaluation = self._evaluation(curve, tags)
        measured = np.array([tag.pose for tag in tags])
        prior = self.prior
        slack = (
            (prior.tag_position, prior.tag_heading)
            if curve.degrees
            else (prior.arc_position, prior.arc_heading)
        )
        extra = np.array([slack[0], slack[0], slack[1]]) ** 2
        whiten = np.array(
            [np.linalg.inv(np.linalg.cholesky(tag.covariance + np.diag(extra))) for tag in tags]
        )
        weak = 1.0 / self._prior_sigma(curve)
        parameters = start[: curve.size].copy()
        count = PLACE * len(tags)
        for _ in range(12):
            places, jacobian = evaluation.places(parameters)
            gap = measured - places
            gap[:, 2] = wrap(gap[:, 2])
            rows = np.vstack([(whiten @ jacobian).reshape(count, -1), np.diag(weak)])
            right = np.concatenate(
                [np.einsum("nij,nj->ni", whiten, gap).ravel(), -weak * parameters]
            )
            normal = rows.T @ rows
            move = np.linalg.solve(normal, rows.T @ right)
            # A step of more than a radian of heading is damped: the fit may start far away.
            reach = float(np.abs(evaluation._inner @ move).max())
            parameters = parameters + move * min(1.0, 1.0 / max(reach, 1e-9))
            if reach < 1e-9 and float(np.abs(move[:2]).max()) < 1e-9:
                break
        gain = np.linalg.solve(normal, rows[:count].T).reshape(-1, len(tags), PLACE)
        gain = np.einsum("pni,nij->pnj", gain, whiten)
        # I - G J, times the prior: how much of each parameter the measurements leave open.
        left_open = (np.eye(curve.size) - np.einsum("pnj,njq->pq", gain, jacobian)) / weak
        return _Fit(parameters, gain, gap, left_open)

    def _estimate(
        self,
        fit: _Fit,
        arcs: _Fit,
        tags: Sequence[PlanarTag],
        rejected: dict[int, float],
        common: NDArray[np.float64] | None,
    ) -> LimbEstimate:
        curve, slopes = self._outline.places(fit.parameters)
        noise = np.zeros((2, 2))
        systematic = np.zeros((2, 2))
        tip_gain = np.einsum("ip,pnj->inj", slopes[-1, :2], fit.gain)
        for i, tag in enumerate(tags):
            noise += tip_gain[:, i] @ tag.covariance @ tip_gain[:, i].T
            systematic += (tip_gain[:, i] * self._mounting**2) @ tip_gain[:, i].T
        if common is not None:
            shared = np.einsum("inj,njk->ik", tip_gain, common)
            systematic += shared @ shared.T
        # What the tags do not determine, the prior leaves open.
        undetermined = slopes[-1, :2] @ fit.left_open
        systematic += undetermined @ undetermined.T
        # A tip that may be far to the side is also nearer: the second order of a long arc.
        systematic += (np.sum(undetermined**2) / self._smooth.ends[-1]) ** 2 * np.eye(2)
        bends = arcs.parameters[4 : 4 + self._constant.segments]
        bending = self._constant.active
        bend_gain = arcs.gain[4:]
        variance = np.zeros(self._constant.segments)
        for i, tag in enumerate(tags):
            spread = tag.covariance + np.diag(self._mounting**2)
            variance += np.einsum("pj,jk,pk->p", bend_gain[:, i], spread, bend_gain[:, i])
        variance += np.sum(arcs.left_open[4:] ** 2, axis=1)
        return LimbEstimate(
            tip=curve[-1, :2],
            tip_covariance=noise,
            tip_systematic=systematic,
            tip_heading=float(curve[-1, 2]),
            bend_angle=bends * bending,
            bend_angle_sigma=np.sqrt(variance) * bending,
            curvature=bends,
            elongation=1.0 + float(fit.parameters[3]),
            residual=float(np.sqrt(np.mean(np.sum(arcs.residuals[:, :2] ** 2, axis=1)))),
            curve=curve[:, :2],
            tags_used=tuple(tag.id for tag in tags),
            rejected=rejected,
        )
