"""From what a check has found to the driver's wiring."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from apriltag_tracker.bodies.body_map import BodyMap
from apriltag_tracker.pose.clamp import Clamp
from apriltag_tracker.tag_map import TagMap
from der_planner.commands.check_rig import _move_base, played_wiring
from der_planner.identification.rig import RigError, RigFinding, ValveFinding
from pressure_driver.protocols import SettingError

CONFIG = Path(__file__).resolve().parents[3] / "src" / "apriltag_tracker" / "config"


def found(*moves: tuple[int, int], contradictions: tuple[str, ...] = ()) -> RigFinding:
    """Return what a check finds whose valves bend these segments to these sides."""
    valves = tuple(
        ValveFinding(valve, valve, segment, side, 3000.0, 0.1 * side, 1.0, 0.05, 0.05, ())
        for valve, (segment, side) in enumerate(moves)
    )
    return RigFinding(valves, (0, 1), 2.0, ("a", "b"), contradictions, ())


@pytest.mark.parametrize(
    ("moves", "before", "wiring"),
    [
        (((0, 1), (0, -1), (1, 1), (1, -1)), "", "1,2,3,4"),
        (((0, -1), (0, 1), (1, 1), (1, -1)), "", "2,1,3,4"),
        (((1, -1), (1, 1), (0, 1), (0, -1)), "", "3,4,2,1"),
        # A check that was played with a wiring finds what is left to change.
        (((0, 1), (0, -1), (1, 1), (1, -1)), "3,4,2,1", "3,4,2,1"),
        (((0, -1), (0, 1), (1, 1), (1, -1)), "3,4,2,1", "4,3,2,1"),
    ],
)
def test_the_driver_gets_the_valve_of_each_chamber(moves, before, wiring):
    assert played_wiring(found(*moves), {"wiring": before}) == wiring


def test_what_cannot_be_played_is_refused():
    crossed = found((0, 1), (1, 1), (0, -1), (1, -1))
    assert played_wiring(crossed, {"protocol": "native"}) == "1,3,2,4"
    with pytest.raises(SettingError, match="hoses of each segment on one pair"):
        played_wiring(crossed, {})
    with pytest.raises(RigError, match="wrong port"):
        played_wiring(found((0, 1), (0, 1), (1, 1), (1, -1), contradictions=("wrong port",)), {})


@pytest.mark.parametrize("poses", [False, True])
def test_a_clamp_beside_limb_base_gives_the_tracker_a_map_of_its_own(tmp_path: Path, poses: bool):
    kind, name = (BodyMap, "bodies.yaml") if poses else (TagMap, "tags.yaml")
    content = {"poses": {}} if poses else {}
    _move_base(
        content,
        CONFIG / name,
        Clamp(np.array([0.01, 0.0, 0.0]), np.zeros(3)),
        tmp_path / "rig.yaml",
    )
    (written,) = content["poses"].values() if poses else content["tracker"].values()
    old, new = kind.from_yaml(CONFIG / name), kind.from_yaml(written)
    before, after = (each.fixed if poses else each.world for each in (old, new))
    assert after[0].position[0] == pytest.approx(before[0].position[0] - 0.01)
