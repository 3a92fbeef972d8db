"""Where the limb is clamped, found from the limb itself, beside where a map says that it is."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from apriltag_tracker.bodies.body_map import BodyMap
from apriltag_tracker.pose.shape import (
    FollowerOptions,
    PlanarTag,
    ShapeFitter,
    ShapePrior,
    centreline_pose,
)
from apriltag_tracker.tag_map import TagMap

_FREE = FollowerOptions(
    reject_beyond=1.0,
    prior=ShapePrior(base_position=0.05, base_heading=0.5, corrections=(2.0,)),
)
"""The clamp may be anywhere near; the limb bends nearly as arcs."""
_NOISE = np.diag([1e-4, 1e-4, 3e-3]) ** 2
_MOST = 60
"""Frames that are looked at."""


class Clamp(NamedTuple):
    """Where the limb begins in `limb_base`, where all should be zero.

    Attributes:
        place: (3,) x, y [m] and heading [rad].
        sigma: (3,) standard deviations, from how much frames differ.
    """

    place: NDArray[np.float64]
    sigma: NDArray[np.float64]


def find_clamp(bodies: TagMap | BodyMap, places: NDArray[np.float64]) -> Clamp | None:
    """Find where a limb is clamped from frames in which it bends to all sides.

    Args:
        bodies: the map of its tags or bodies.
        places: (K, n, 3) x, y [m], heading [rad] of those on the limb; NaN where not seen.

    Returns:
        The clamp; None if fewer than three frames show three of them.
    """
    fitter = ShapeFitter(bodies, _FREE)
    seen = np.asarray(np.isfinite(places).all(axis=2))
    frames = np.flatnonzero(seen.sum(axis=1) >= 3)
    found = []
    for k in frames[np.linspace(0, len(frames) - 1, min(_MOST, len(frames))).astype(int)]:
        tags = []
        for i in np.flatnonzero(seen[k]).tolist():
            pose = centreline_pose(places[k, i], bodies.limb[i].offset)
            tags.append(PlanarTag(i, bodies.limb[i].arc_length, pose, _NOISE))
        estimate = fitter.fit(tags)
        if estimate is not None:
            steps = np.diff(estimate.curve[:3], axis=0)
            first, second = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
            # Each chord has the heading of its middle.
            found.append([*estimate.curve[0], first - 0.5 * (second - first)])
    if len(found) < 3:
        return None
    table = np.array(found)
    # Frames of one run are alike: what they differ by does not average out.
    return Clamp(np.median(table, axis=0), table.std(axis=0))


def at_clamp(content: dict[str, Any], clamp: Clamp) -> dict[str, Any]:
    """Return the content of a map whose `limb_base` is where the limb is clamped.

    Args:
        content: of the file of a tag map or body map.
        clamp: in the `limb_base` of that.
    """
    shift, turn = np.array([*clamp.place[:2], 0.0]), Rotation.from_euler("z", clamp.place[2])

    def moved(entry: dict[str, Any]) -> dict[str, Any]:
        if "position" not in entry:
            return entry
        found = {"position": turn.inv().apply(entry["position"] - shift).tolist()}
        if "rotation" in entry:
            found["rotation"] = (
                (turn.inv() * Rotation.from_quat(entry["rotation"])).as_quat().tolist()
            )
        elif "id" in entry:
            found["yaw"] = float(entry.get("yaw", 0.0) - clamp.place[2])
        return entry | found

    if "world" in content:
        return content | {"world": {"tags": [moved(tag) for tag in content["world"]["tags"]]}}
    found = content | {"bodies": [moved(body) for body in content["bodies"]]}
    if "frame" in content:
        # It says where `limb_base` is, and not what is in it.
        base = Rotation.from_quat(content["frame"]["rotation"])
        place = content["frame"]["position"] + base.apply(shift)
        found["frame"] = {"position": place.tolist(), "rotation": (base * turn).as_quat().tolist()}
    return found
