"""The limb from rigid bodies of a simulated motion capture system, in messages of any tracker."""

from __future__ import annotations

import dataclasses
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseArray, PoseStamped, TransformStamped
from scipy.spatial.transform import Rotation

from apriltag_tracker.bodies.body_map import BodyMap
from apriltag_tracker.bodies.forms import PoseFormError, message_type, poses_of, topics_of
from apriltag_tracker.bodies.tracker import (
    BodyNoise,
    BodyTracker,
    FrameAssembler,
    PlaneWatch,
    fit_frame,
)
from apriltag_tracker.pose.shape import FollowerOptions, Uncertainty
from apriltag_tracker.synthetic.poses import MocapFaults, SyntheticMocap
from apriltag_tracker.tag_map import MapError

PERIOD = 1.0 / 120.0
NOISE = MocapFaults(position_noise=1e-4, direction_noise=3e-3)


@pytest.fixture(scope="session")
def bodies(config) -> BodyMap:
    found = BodyMap.from_yaml(config / "bodies.yaml")
    # The limb of these tests has no stiff stretches: its arcs are exact.
    return dataclasses.replace(found, stiff=())


def run(mocap, swing, count, tracker=None):
    """Return stamps [s], true tips and observations of a swinging limb."""
    tracker = tracker or BodyTracker(mocap.bodies, noise=BodyNoise(1e-4, 3e-3))
    times = 10.0 + PERIOD * np.arange(count)
    shapes = [swing.shape(time) for time in times]
    found = [
        tracker.observe(mocap.frame(round(1e9 * time), shape))
        for time, shape in zip(times, shapes, strict=True)
    ]
    return times, np.array([shape.points[-1] for shape in shapes]), found


def errors(tips, found):
    return np.array([each.followed.estimate.tip for each in found]) - tips


@pytest.mark.parametrize(
    ("turn", "unit"), [((0.1, 0.0, 0.3), 1.0), ((-1.5, 0.0, 0.3), 1e-3), ((0.1, 1.6, 0.0), 1e-2)]
)
def test_the_tip_is_found_in_any_frame_and_unit(bodies, swing, turn, unit):
    mocap = SyntheticMocap(dataclasses.replace(bodies, unit=unit))
    mocap.rotation = Rotation.from_rotvec(turn).as_matrix()
    _, tips, found = run(mocap, swing, 10)
    assert np.abs(errors(tips, found)).max() < 5e-5
    assert all(not each.followed.reason for each in found)


def test_noise_comes_out_as_the_covariance_says(bodies, swing):
    options = FollowerOptions(uncertainty=Uncertainty(survey=0, mounting=0, mounting_angle=0))
    tracker = BodyTracker(bodies, options, BodyNoise(1e-4, 3e-3))
    _, tips, found = run(SyntheticMocap(bodies, NOISE, seed=4), swing, 400, tracker)
    # The base settles first.
    gaps, late = errors(tips, found)[100:], found[100:]
    spreads = [each.followed.estimate.tip_covariance for each in late]
    ratio = np.mean([gap @ np.linalg.solve(s, gap) for gap, s in zip(gaps, spreads, strict=True)])
    assert 0.6 < ratio / 2 < 1.5
    assert np.sqrt(np.mean(np.sum(gaps**2, axis=1))) < 2e-4


def test_lost_bodies_are_named_and_the_tip_stays(bodies, swing):
    faults = dataclasses.replace(NOISE, dropout=0.1)
    _, tips, found = run(SyntheticMocap(bodies, faults, seed=1), swing, 200)
    valid = [k for k, each in enumerate(found) if each.followed.estimate is not None]
    assert len(valid) > 180
    assert any("without body limb_3" in each.followed.reason for each in found)
    every = [k for k in valid if len(found[k].followed.estimate.tags_used) == len(bodies.limb)]
    assert np.abs(errors(tips[every], [found[k] for k in every])).max() < 1e-3


def test_a_body_that_stands_still_while_others_move_is_lost(bodies, swing):
    mocap, tracker = SyntheticMocap(bodies, NOISE), BodyTracker(bodies)
    frozen = bodies.names.index("limb_4")
    first = mocap.frame(0, swing.shape(0.0))
    for k in range(1, 30):
        frame = mocap.frame(round(k * PERIOD * 1e9), swing.shape(k * PERIOD))
        frame.positions[frozen], frame.quaternions[frozen] = (
            first.positions[frozen],
            first.quaternions[frozen],
        )
        seen = tracker.observe(frame)
    assert np.isnan(seen.places[3]).all()
    assert "without body limb_4" in seen.followed.reason


def test_poses_that_do_not_change_at_all_are_of_a_paused_source(bodies, swing):
    frame, tracker = SyntheticMocap(bodies, NOISE).frame(0, swing.shape(0.0)), BodyTracker(bodies)
    found = [tracker.observe(frame._replace(stamp=k * 10**7)).followed for k in range(33)]
    assert [each.estimate is None for each in found] == [False] * 30 + [True] * 3
    assert "is their source paused?" in found[-1].reason


def test_mirrored_positions_of_flat_fixed_bodies_are_named(bodies, swing):
    def flat(side):
        places = [body.position * [1.0, side, 0.0] for body in bodies.fixed]
        fixed = zip(bodies.fixed, places, strict=True)
        return dataclasses.replace(
            bodies, fixed=tuple(dataclasses.replace(b, position=p, rotation=None) for b, p in fixed)
        )

    _, _, found = run(SyntheticMocap(flat(1.0)), swing, 3, BodyTracker(flat(1.0)))
    assert found[-1].followed.estimate is not None
    _, _, found = run(SyntheticMocap(flat(1.0)), swing, 3, BodyTracker(flat(-1.0)))
    assert found[-1].followed.estimate is None
    assert "names and signs of fixed bodies" in found[-1].followed.reason


def test_what_no_body_can_be_is_not_seen(bodies, swing):
    mocap, tracker = SyntheticMocap(bodies, NOISE), BodyTracker(bodies)
    for k in range(300):
        frame = mocap.frame(round(k * PERIOD * 1e9), swing.shape(k * PERIOD))
        frame.positions[bodies.names.index("limb_1")] = 1e300
        frame.positions[bodies.names.index("limb_2")] = 0.0
        found = tracker.observe(frame._replace(quaternions=0.5 * frame.quaternions)).followed
        assert found.reason == "without body limb_1, limb_2"
    assert float(tracker.plane.values()["out_of_plane_mm_rms"]) < 0.2
    empty = frame._replace(quaternions=np.zeros_like(frame.quaternions))
    assert "no fixed body with a quaternion" in BodyTracker(bodies).observe(empty).followed.reason


@pytest.mark.parametrize("swapped", [("limb_2", "limb_4"), ("limb_4", "limb_5")])
def test_bodies_with_each_others_names_tell_no_tip(bodies, swing, swapped, monkeypatch):
    mocap = SyntheticMocap(bodies, NOISE)
    right, pair = mocap.frame, [bodies.names.index(name) for name in swapped]

    def swap_later(stamp, shape):
        frame = right(stamp, shape)
        if stamp >= 10.5e9:
            for numbers in (frame.positions, frame.quaternions):
                numbers[pair] = numbers[pair[::-1]]
        return frame

    monkeypatch.setattr(mocap, "frame", swap_later)
    _, tips, found = run(mocap, swing, 120)
    told = [k for k, each in enumerate(found) if each.followed.estimate is not None]
    assert 60 <= len(told) < 70, "bridged and then not told any more"
    assert np.abs(errors(tips[told], [found[k] for k in told])).max() < 2e-3
    assert found[-1].followed.reason


def test_fixed_bodies_that_do_not_fit_together_are_an_error(bodies, swing):
    mocap = SyntheticMocap(bodies, NOISE)
    moved = dataclasses.replace(bodies.fixed[1], position=np.array([0.13, 0.28, 0.0]))
    wrong = dataclasses.replace(bodies, fixed=(bodies.fixed[0], moved, *bodies.fixed[2:]))
    tracker = BodyTracker(wrong)
    seen = tracker.observe(mocap.frame(0, swing.shape(0.0)))
    assert seen.followed.estimate is None
    assert "do not fit together" in seen.followed.reason


def test_the_base_follows_bodies_of_the_table_that_move_together(bodies, swing):
    tracker = BodyTracker(bodies, noise=BodyNoise(1e-4, 3e-3))
    run(SyntheticMocap(bodies, NOISE), swing, 60, tracker)
    shifted = SyntheticMocap(bodies, NOISE)
    shifted.origin += 0.01
    _, tips, found = run(shifted, swing, 300, tracker)
    assert np.abs(errors(tips[-20:], found[-20:])).max() < 1e-3


def test_points_on_a_line_tell_no_frame():
    line = np.outer(np.arange(4.0), [1.0, 2.0, 0.5])
    assert fit_frame(line, line) is None


def test_the_plane_of_motion_is_told_with_its_tilt(swing, bodies):
    watch, tilt = PlaneWatch(np.array([0.0, 0.02])), np.deg2rad(3.0)
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    assert "not moved enough" in watch.values()["plane"]
    for time in np.arange(0.0, 6.0, 0.05):
        points = swing.shape(time).points[[60, -1]]
        watch.take(np.column_stack([points, [0.0, 0.02]]) @ turn.T)
    told = watch.values()
    assert float(told["plane_tilt_deg"]) == pytest.approx(3.0, abs=0.1)
    assert told["plane_tilt_toward_deg"] == "-90"
    assert float(told["out_of_plane_mm_rms"]) < 0.05


def pose(x):
    return (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@pytest.fixture
def assembler(bodies):
    return FrameAssembler(dataclasses.replace(bodies, names=("a", "b", "c")))


def stamps_of(assembler, *come):
    """Take bodies, each as "name stamp in ms"; return the stamps of the frames that they end."""
    told = []
    for name, stamp in (each.split() for each in come):
        frames = assembler.take(name, round(1e6 * float(stamp)), pose(float(stamp)))
        told.append([round(frame.stamp * 1e-6) for frame in frames])
    return told


def every_10_ms(assembler, count, **late):
    """Take all bodies so often, late by some ms; return the stamps of the frames."""
    come = [f"{name} {10 * k + after}" for k in range(count) for name, after in late.items()]
    return [stamp for frames in stamps_of(assembler, *come) for stamp in frames]


def test_poses_that_come_one_by_one_become_frames(assembler):
    assert stamps_of(assembler, "a 0", "b 0") == [[], []]
    (frame,) = assembler.take("c", 400_000, pose(3.0))
    assert frame.stamp == 0
    assert frame.positions[:, 0].tolist() == [0.0, 0.0, 3.0]
    assert stamps_of(assembler, "stranger 10") == [[]]
    assert assembler.unknown == {"stranger": 1}


def test_bodies_may_be_a_frame_behind_each_other(assembler):
    told = stamps_of(assembler, "a 0", "a 10", "b 0", "c 0", "b 10", "a 20", "c 10", "b 20", "c 20")
    assert told == [[], [], [], [0], [], [], [10], [], [20]]


def test_a_body_that_is_lost_holds_up_frames_and_comes_back(assembler):
    # One that misses a frame is known to do so as soon as the next frame is whole.
    told = stamps_of(assembler, "a 0", "b 0", "a 10", "b 10", "c 10")
    assert told[-1] == [0, 10]
    # One that is gone is waited for until two more frames have begun.
    told = stamps_of(assembler, "a 20", "b 20", "a 30", "b 30", "a 40", "b 40", "a 50", "b 50")
    assert told == [[], [], [], [], [20], [30, 40], [], [50]]
    told = stamps_of(assembler, "c 50", "a 60", "b 60", "c 60")
    assert told == [[], [], [], [60]]


def test_bodies_may_be_stamped_one_by_one(assembler):
    assert every_10_ms(assembler, 4, a=0, b=2, c=4.5) == [0, 10, 20, 30]
    # The second is late, the first comes early.
    assert stamps_of(assembler, "c 44", "a 41", "b 43.5")[-1] == [44]


def test_a_body_of_another_clock_is_left_out_by_name(assembler):
    told = every_10_ms(assembler, 20, a=0, b=3000, c=0)
    assert told == [10 * k for k in range(len(told))]
    assert len(told) >= 18
    assert assembler.astray == pytest.approx({"b": 3.0}, abs=0.01)


def test_a_clock_that_was_set_back_begins_anew(assembler):
    assert stamps_of(assembler, "a 5000", "b 5000", "c 5000")[-1] == [5000]
    assert stamps_of(assembler, "a 1000", "b 1000", "c 1000")[-1] == [1000]


def test_wrong_maps_are_named(bodies):
    limb = {"segment_lengths": [0.122, 0.122]}
    on_limb = {"name": "a", "arc_length": 0.1}
    for change, said in (
        ({"schema": 2}, "schema: 1"),
        ({"length_unit": "inch"}, "length_unit is 'inch': choose m, cm, mm"),
        ({"bodies": [on_limb, on_limb]}, "listed twice"),
        ({}, "the key frame"),
        ({"bodies": [{**on_limb, "arc_length": 0.3}]}, "not on the limb"),
        ({"bodies": [{"name": "a"}]}, "place: clamp"),
        ({"bodies": [{**on_limb, "colour": 1}]}, "unknown key 'colour'"),
        ({"bodies": [{**on_limb, "rotation": [0, 0, 0, 2]}]}, "no quaternion"),
        ({"bodies": [{"name": "a", "place": "world", "position": [0, 0, 0]}]}, "arc_length"),
    ):
        with pytest.raises(MapError, match=said):
            BodyMap.from_dict({"schema": 1, "limb": limb, "bodies": [on_limb], **change})


NAMES = ("clamp", "tip")
STAMP = Time(sec=2, nanosec=5)
HEADER = SimpleNamespace(stamp=STAMP)


def pose_at(x: float) -> Pose:
    found = Pose()
    found.position.x, found.orientation.w = x, 1.0
    return found


def transform(name: str, x: float) -> TransformStamped:
    found = TransformStamped(child_frame_id=name)
    found.header.stamp = STAMP
    found.transform.translation.x, found.transform.rotation.w = x, 1.0
    return found


def named(name: str, x: float) -> SimpleNamespace:
    return SimpleNamespace(name=name, pose=pose_at(x))


# Two of the types are of packages that are not installed here.
MESSAGES = {
    "pose_array": PoseArray(poses=[pose_at(1.0), pose_at(2.0)]),
    "tf": SimpleNamespace(transforms=[transform("clamp", 1.0), transform("tip", 2.0)]),
    "named_pose_array": SimpleNamespace(
        header=HEADER, poses=[named("clamp", 1.0), named("tip", 2.0)]
    ),
}
MESSAGES["pose_array"].header.stamp = STAMP


@pytest.mark.parametrize("form", MESSAGES)
def test_all_bodies_of_a_message_are_told(form):
    found = list(poses_of(form, MESSAGES[form], "", NAMES))
    assert [each.name for each in found] == list(NAMES)
    assert {each.stamp for each in found} == {2_000_000_005}
    assert [each.pose for each in found] == [(x, 0, 0, 0, 0, 0, 1) for x in (1.0, 2.0)]


def test_a_topic_of_its_own_names_the_body():
    message = PoseStamped(pose=pose_at(3.0))
    assert list(poses_of("pose_stamped", message, "tip", NAMES)) == [
        ("tip", 0, (3.0, 0, 0, 0, 0, 0, 1))
    ]
    assert topics_of("pose_stamped", "", NAMES)["tip"] == "poses/tip/pose"
    with pytest.raises(PoseFormError, match=r"\{body\}"):
        topics_of("pose_stamped", "poses", NAMES)


def test_what_cannot_be_is_refused_with_the_remedy(monkeypatch):
    with pytest.raises(PoseFormError, match="array of 2 poses came, the body map has 1 bodies"):
        list(poses_of("pose_array", MESSAGES["pose_array"], "", NAMES[:1]))
    message = SimpleNamespace(TFMessage=SimpleNamespace)
    for module in ("tf2_msgs", "tf2_msgs.msg"):
        monkeypatch.setitem(sys.modules, module, message)
    assert message_type("tf") is SimpleNamespace
    # A module that is None in sys.modules cannot be imported.
    monkeypatch.setitem(sys.modules, "motion_capture_tracking_interfaces.msg", None)
    with pytest.raises(PoseFormError, match="install ros-jazzy-motion-capture-tracking-interfaces"):
        message_type("named_pose_array")
