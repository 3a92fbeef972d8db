"""The force of a touch, and where it acts: what explains the pressures that a model lacks.

The estimator (`der_planner.estimation.estimator`) says per segment the pressure d + g w that the
model lacks, and a displacement b of the tip that the bend angles do not explain. A force f at a
place s makes both, by the compliance of the rod (`der_planner.model.compliance`): with C_θ and C_r
of bend and tip by the force, C_w of the bend by pressure, and J = ∂tip/∂θ of evenly bent segments,

    lacking pressure = C_w⁻¹ C_θ(s) f        b = (C_r(s) − J C_θ(s)) f

These are M + 2 numbers for the three unknowns of a force in the plane. They hardly show the part of
a force that acts along the limb. What touches the limb from its side pushes across it, with some
friction: the part along the limb is therefore expected to be a share of the part across it. For
each place the most likely force follows from linear equations. The most likely place and its force
are told; the likelihood of all places, each with its force, gives their deviations.

Without gravity pressures and bends tell only the ratio of gain and stiffness, and forces count as
stiffness does. Where a limb's swings told it (`CalibratedRange.bending_stiffness`), they count by
that.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammainccinv

from der_planner.arrays import Array
from der_planner.estimation.free_level import Lacking
from der_planner.model import RodModel
from der_planner.model.compliance import compliance

_LARGEST_FORCE = 2.3
"""Standard deviation of the forces across the limb that are expected, over what the largest moment
of its pressures makes at its length."""
_RUBS = 0.3
"""Standard deviation of a force along the limb, over the force across it at the same place."""
_LEAST_ALONG = 0.012
"""The same of a force along the limb that is expected anyway."""
EFFECT_WRONG = 0.1
"""Standard deviation of what a weight or a force is said to do, over that."""
_UNEVEN = 0.02
"""The same of how far the tip moves beside its bend, over how far the bend moves it."""
_PLACE_TOLD = 0.1
"""Standard deviation of the place, over the limb's length, up to which it is told."""
UNLIKELY = 1e-3
"""Probability of what is left of the data below which it is not one force."""


@dataclass(frozen=True)
class Touch:
    """What is known of a touch at an instant.

    Attributes:
        time: [s].
        bend_angles: (M,) of the limb then [rad].
        touched: whether something touches the limb.
        since: when it began [s]; NaN: nothing touches.
        pressure: (M,) effective pressure that bends the limb as the touch does [Pa]; NaN: nothing
            touches.
        distance: squared distance from the free level over that of one false alarm in an hour.
        place: along the limb from its clamp [m]; NaN: it cannot be told.
        place_deviation: its standard deviation, told or not [m].
        force: (2,) on the limb [N]; NaN: it cannot be told.
        force_covariance: (2, 2), told or not [N²].
        said: a sentence on what is told; empty while nothing touches or pulls.
        payload: at the tip, beside what was planned [kg].
        suspected: whether something touches, or may touch while friction hides it.
    """

    time: float
    bend_angles: Array
    touched: bool
    since: float
    pressure: Array
    distance: float
    place: float
    place_deviation: float
    force: Array
    force_covariance: Array
    said: str
    payload: float = 0.0
    suspected: bool = False


def untouched(time: float, bend_angles: Array, distance: float = 0.0) -> Touch:
    """Return that nothing touches a limb of bend angles (M,) [rad] at an instant [s]."""
    never = unknown = np.nan
    pressure, force, covariance = (np.full(n, np.nan) for n in (len(bend_angles), 2, (2, 2)))
    about = pressure, distance, unknown, unknown, force, covariance, ""
    return Touch(time, bend_angles, False, never, *about)


def locate(model: RodModel, lacking: Lacking, places: Array) -> Touch:
    """Return the force that explains what the model lacks, and where it acts.

    Args:
        model: rod of the limb.
        lacking: of the model, less the free level, with the covariance of that.
        places: (P,) evenly spaced, where the force may act [m].
    """
    axes = _axes(model, lacking.bend_angles, places)
    effect = effects(model, lacking.bend_angles, places) @ axes
    bent = compliance(model, lacking.bend_angles, places[-1:]).bend_by_pressure
    moved = model.kinematics.tip_jacobians(lacking.bend_angles) @ bent @ lacking.value[:-2]
    doubt = EFFECT_WRONG * lacking.value
    doubt[-2:] = _UNEVEN * np.linalg.norm(moved)
    weight = np.linalg.inv(lacking.doubtful + np.diag(doubt**2))
    seen = np.swapaxes(effect, 1, 2) @ weight
    square, pull = seen @ effect, seen @ lacking.value
    usual = model.limb.tip_force
    largest = _LARGEST_FORCE * usual
    across = pull[:, 1] / (square[:, 1, 1] + largest**-2)
    expected = np.full_like(pull, largest)
    expected[:, 0] = _LEAST_ALONG * usual + _RUBS * np.abs(across)
    told = square + (expected**-2.0)[:, :, None] * np.eye(2)
    forces = np.linalg.solve(told, pull[..., None])[..., 0]
    left = lacking.value @ weight @ lacking.value - (pull * forces).sum(axis=1)
    likely = -0.5 * (left + np.linalg.slogdet(told)[1]) - np.log(expected[:, 0])
    # A small force is as likely as a large one: else a place where a large one fits would be told.
    likely -= np.log(np.hypot(np.linalg.norm(forces, axis=1), _LEAST_ALONG * usual))
    share = np.exp(likely - likely.max())
    share /= share.sum()
    # The mean of all places would never lie at the tip.
    best = int(np.argmax(share))
    place = float(places[best])
    deviation = float(np.sqrt(share @ (places - place) ** 2 + (places[1] - places[0]) ** 2 / 12))
    turned = np.einsum("pab,pb->pa", axes, forces)
    force = turned[best]
    apart = turned - force
    spread = axes @ np.linalg.inv(told) @ np.swapaxes(axes, 1, 2)
    spread = spread + apart[:, :, None] * apart[:, None, :]
    covariance = np.einsum("p,pab->ab", share, spread)
    known = replace(
        untouched(lacking.time, lacking.bend_angles),
        touched=True,
        since=lacking.time,
        pressure=lacking.value[:-2],
        place=place,
        place_deviation=deviation,
        force=force,
        force_covariance=covariance,
    )
    return _told(known, float(left.min()), model)


def effects(model: RodModel, bend_angles: Array, places: Array) -> Array:
    """Return what a unit force makes the model lack (P, M + 2, 2) [Pa/N], [m/N], see the module."""
    limp = compliance(model, bend_angles, places)
    jacobian = model.kinematics.tip_jacobians(bend_angles)
    lacking = np.linalg.solve(limp.bend_by_pressure, limp.bend)
    stiffer = model.limb.calibrated.bending_stiffness
    if len(stiffer) == model.inputs:
        own = np.array([segment.bending_stiffness for segment in model.limb.segments])
        lacking *= (own / stiffer)[:, None]
    return np.concatenate([lacking, limp.tip - jacobian @ limp.bend], axis=1)


def _axes(model: RodModel, bend_angles: Array, places: Array) -> Array:
    """Return the directions along and across the limb at places, as columns (P, 2, 2)."""
    even = model.kinematics
    edges = np.searchsorted(np.cumsum(even.rest_lengths[:-1]) + even.base, places)
    heading = even.turning[edges] @ bend_angles
    cosine, sine = np.cos(heading), np.sin(heading)
    return np.moveaxis(np.array([[cosine, -sine], [sine, cosine]]), 2, 0)


def _told(found: Touch, left: float, model: RodModel) -> Touch:
    """Say what can be told of a force, and leave out what cannot.

    Args:
        found: place and force of the largest likelihood.
        left: squared distance of the data from the best force.
        model: of the limb.
    """
    nothing = np.full(2, np.nan)
    spare = max(1, model.inputs - 1)
    if left > exceeded(UNLIKELY, spare):
        said = "at several points, or the model is wrong otherwise: no single force explains it"
        return replace(found, place=np.nan, force=nothing, said=said)
    deviations, directions = np.linalg.eigh(found.force_covariance)
    size = float(np.linalg.norm(found.force))
    said = f"{size:.2f} N"
    where = f"at {found.place * 100:.1f} cm (± {found.place_deviation * 100:.1f})"
    if found.place_deviation > _PLACE_TOLD * model.limb.length:
        found, where = replace(found, place=np.nan), "its place is not known"
    widest = float(np.sqrt(deviations[-1]))
    if widest > size:
        x, y = directions[:, -1]
        said = f"its force is not known along ({x:.2f}, {y:.2f}): ± {widest:.2f} N"
        found = replace(found, force=nothing)
    return replace(found, said=f"{said}, {where}")


def exceeded(probability: float, count: int) -> float:
    """Return what the sum of ``count`` squares of normal numbers exceeds with a probability."""
    return float(2.0 * gammainccinv(count / 2, probability))
