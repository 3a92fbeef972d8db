"""From what a check has found to the driver's wiring."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from apriltag_tracker.bodies.body_map import BaseFrame, BodyMap
from apriltag_tracker.bodies.tracker import BodyTracker
from apriltag_tracker.pose.clamp import find_clamp
from apriltag_tracker.synthetic.poses import MocapFaults, SyntheticMocap
from apriltag_tracker.synthetic.shapes import constant_curvature
from der_planner.commands.check_rig import found_frame, played_wiring
from der_planner.identification.rig import RigError, RigFinding, ValveFinding
from pressure_driver.settings import SettingError


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


def test_the_frame_of_a_map_without_fixed_bodies_is_found():
    """The first shape is bent, and the plane of motion is tilted by 2 degrees."""
    path = Path(__file__).resolve().parents[3] / "src/apriltag_tracker/config/bodies.yaml"
    whole = dataclasses.replace(BodyMap.from_yaml(path), stiff=())
    names = tuple(body.name for body in whole.limb)
    bodies = dataclasses.replace(whole, fixed=(), names=names)
    noise = MocapFaults(position_noise=1e-4, direction_noise=2e-3)
    mocap, tracker = SyntheticMocap(bodies, noise, tilt=np.deg2rad(2.0)), BodyTracker(bodies)
    bends = [(0.06, 0.03), *((a, b) for a in (-0.2, 0.0, 0.2) for b in (-0.2, 0.0, 0.2))] * 4
    shapes = [constant_curvature(bodies.segment_lengths, each) for each in bends]
    frames = [mocap.frame(round(5e7 * k), shape) for k, shape in enumerate(shapes)]
    places = np.array([tracker.observe(frame).places for frame in frames])
    assert tracker.base.guessed
    arcs = np.array([body.arc_length for body in bodies.limb])
    clamp = find_clamp(bodies, arcs, [body.offset for body in bodies.limb], places)
    told = {"frame": json.dumps(tracker.base.frame.as_mapping()), **tracker.plane.values()}
    frame = BaseFrame.from_mapping(found_frame(clamp, told, bodies.limb[0].height))
    # The axes of the limb's base in the frame of the poses.
    assert np.degrees(np.arccos(frame.rotation.T[:, 2] @ mocap.rotation[:, 2])) < 0.5
    assert np.abs(frame.of(mocap.origin[None])).max() < 1e-3
    checked = BodyTracker(dataclasses.replace(bodies, frame=frame))
    tips = [checked.observe(each).followed.estimate.tip for each in frames]
    wrong = np.array(tips) - [shape.points[-1] for shape in shapes]
    assert np.sqrt(np.mean(np.sum(wrong**2, axis=1))) < 2e-3
