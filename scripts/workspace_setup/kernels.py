"""Compile the kernels of planner, twin, camera and tracker, so that no node starts cold.

The set-up runs this module when a kernel is new or changed. Unlike the rest of this folder it
imports the packages, but nothing of ROS.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np

from apriltag_tracker.pipeline import LimbTracker
from apriltag_tracker.synthetic.camera import CameraModel, SyntheticCamera
from apriltag_tracker.synthetic.shapes import constant_curvature
from apriltag_tracker.tag_map import TagMap
from der_planner.identification import CalibrationLog
from der_planner.identification.bends import NODES, Predicted
from der_planner.identification.log import Prepared
from der_planner.identification.terms import FreeTerms
from der_planner.limb import Limb
from der_planner.model import CONTROL_PERIOD, RodModel, simulate
from der_planner.planning import METHODS, Motion, plan
from der_planner.rod import Rod
from der_planner.twin.offline import play
from workspace_setup.basics import ROOT

CONFIG = ROOT / "src" / "apriltag_tracker" / "config"


def _track() -> None:
    tags = TagMap.from_yaml(CONFIG / "tags.yaml")
    model = CameraModel.from_yaml(CONFIG / "synthetic_camera.yaml")
    straight = constant_curvature(tags.segment_lengths, [0.0] * len(tags.segment_lengths))
    picture = SyntheticCamera(model, tags).frame(straight).image
    tracker = LimbTracker(tags, model.intrinsics)
    # The first image is searched in full, in the next tags are where they were.
    for stamp in (0.0, 0.03):
        tracker.observe(picture, stamp)
    straight.at(0.1)


def _fitted(limb: Limb) -> Limb:
    """Return a limb with all that a calibration finds: each takes kernels of its own."""
    segments = tuple(
        replace(
            segment,
            friction_moment=300.0 * segment.moment_gain,
            friction_curvature=0.12 / segment.length,
            creep_stiffness=400.0 * segment.moment_gain * segment.length,
            creep_time=8.0,
        )
        for segment in limb.segments
    )
    air = replace(limb.pneumatics, vent_rate=5000.0)
    return replace(limb, segments=segments, pneumatics=air)


def _fit() -> None:
    """Ask for what a fit asks for: angles of a limb with memory by its parameters and inputs."""
    limb = _fitted(Limb.default().mounted("hanging"))
    time, pressure = CONTROL_PERIOD * np.arange(4.0), np.full((4, 2), 500.0)
    found = simulate(limb, time, commands=pressure, linearise=True)
    assert found.derivative is not None
    found.derivative.tangent(pressure)
    log = CalibrationLog(time, pressure, pressure, 0 * pressure, 0 * pressure)
    free = FreeTerms.of(limb, {"gain"})
    prepared = Prepared(log, pressure, log.bend_angles, np.ones(4, dtype=bool), ())
    assert Predicted(free, RodModel(limb, NODES), prepared, free.unknowns.prior).by


def _in_plane() -> None:
    Rod.from_limb(_fitted(Limb.default())).warm_up()


def _in_space() -> None:
    rod = Rod.from_limb(replace(Limb.default(), gravity=(0.0, 0.0, -9.81)))
    rod.warm_up()
    state, pressures = rod.straight_state(), np.zeros((2, 2))
    for method in ("backward_euler", "sdirk2"):
        rod.simulate(state, pressures, CONTROL_PERIOD, method=method, linearise=True)
        rod.linearise_step(state, pressures[0], CONTROL_PERIOD, method=method)


def _plan() -> None:
    limb = _fitted(Limb.default())
    motion = Motion.named("asynchronous", amplitude=0.1, period=2.0, cycles=1)
    for model, methods in METHODS.items():
        for method in methods:
            plan(limb, motion, model, method)


def _twin() -> None:
    play(np.array([0.0, 0.05]), np.zeros((2, 2)))


HALVES = {
    "plane": {"rod": _in_plane, "planner": _plan, "fit": _fit},
    "space": {"rod in space": _in_space, "twin": _twin, "camera and tracker": _track},
}
"""What uses the kernels of each half; none of one half is called by the other."""


def main() -> int:
    """Use every kernel of one half once and say how long each part took."""
    for name, use in HALVES[sys.argv[1]].items():
        begin = time.monotonic()
        use()
        print(f"{name}: {time.monotonic() - begin:.1f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
