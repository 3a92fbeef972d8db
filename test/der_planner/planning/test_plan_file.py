"""Plans as files, plans that begin from what is learned, and plans as they are streamed."""

import dataclasses
import os
import threading
from dataclasses import replace

import numpy as np
import pytest
import yaml
from limbs import mean_error, other_limb, play, with_segments

from der_planner.control import Learner
from der_planner.limb import Limb
from der_planner.model import RodModel
from der_planner.planning import Motion, PlanningError, Start, plan
from der_planner.planning.configuration import configure
from der_planner.planning.correction import Correction, carried_over, nearest
from der_planner.planning.plan_file import learned_plan, read_plan, write_plan
from der_planner.planning.streaming import GRID, Ending, Schedule, Streamer, first_stamp


@pytest.fixture(scope="module")
def bent():
    """Return a plan of a limb that rests bent, which begins where another motion is left.

    One of its numbers was computed by numpy.
    """
    motion = Motion.named("asynchronous", amplitude=0.3, period=3.0, cycles=1)
    start = Start(np.array([0.1, 0.05]), np.zeros(2), np.zeros(2), np.array([500.0, 100.0]))
    limb = with_segments(Limb.default(), rest_curvature=np.float64(0.3))
    return plan(limb, motion, method="projected", start=start)


def test_a_plan_is_read_back_whole(bent, tmp_path):
    beyond = np.arange(2.0 * len(bent.time)).reshape(-1, 2)
    bent = replace(bent, chambers_beyond=beyond)
    write_plan(bent, tmp_path / "kept" / "a.yaml", about={"runs": 3})
    again = read_plan(tmp_path / "kept" / "a.yaml")
    arrays = ("time", "differential_pressure", "tip_reference", "tip_predicted", "chambers_beyond")
    for name in arrays:
        assert np.array_equal(getattr(again, name), getattr(bent, name))
    assert again.limb.to_mapping() == bent.limb.to_mapping()
    assert np.allclose(again.bend_angles, bent.bend_angles, atol=1e-9)
    assert np.array_equal(again.reference.start.bend_angles, bent.reference.start.bend_angles)
    assert np.array_equal(again.reference.rest, bent.reference.rest)
    for name in ("motion", "model", "method", "amplitude", "period", "cycles"):
        assert getattr(again, name) == getattr(bent, name)
    assert [path.name for path in (tmp_path / "kept").iterdir()] == ["a.yaml"]


def test_a_plan_of_another_limb_load_or_name_is_not_played(bent, tmp_path):
    write_plan(bent, tmp_path / "a.yaml")
    assert learned_plan(tmp_path, "a", replace(bent.limb, name="renamed")).motion == "asynchronous"
    with pytest.raises(PlanningError, match=r"another masses\[0\]"):
        learned_plan(tmp_path, "a", bent.limb.carrying(0.02))
    stronger = replace(bent.limb.segments[1], moment_gain=1e-5)
    swapped = replace(bent.limb, segments=(bent.limb.segments[0], stronger))
    with pytest.raises(PlanningError, match=r"another segments\[1\].moment_gain"):
        learned_plan(tmp_path, "a", swapped)
    with pytest.raises(PlanningError, match=r"no learned plan '\.\./a' .* only: a"):
        learned_plan(tmp_path, "../a", bent.limb)
    with pytest.raises(PlanningError, match="set the planner's learned_plans"):
        learned_plan("", "a", bent.limb)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("limb", None, "expected a mapping"),
        ("schema_version", 7, "schema_version 1"),
        ("tip_predicted_m", [[0.0, 0.0]], "tip_predicted_m must be finite"),
        ("differential_pressure_pa", [[0.0, 1e9]], "beyond the limb's limits"),
        ("differential_pressure_pa", [[0.0, 2e4], [0.0, -2e4]], "beyond the limb's limits"),
    ],
)
def test_a_damaged_plan_is_refused_by_name(bent, tmp_path, key, value, said):
    path = tmp_path / "a.yaml"
    write_plan(bent, path)
    content = yaml.safe_load(path.read_text())
    if key == "differential_pressure_pa":
        value = (value * len(bent.time))[: len(bent.time)]
    content[key] = value
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(PlanningError, match=said):
        read_plan(path)
    path.write_text("a: [")
    with pytest.raises(PlanningError, match=r"the plan .*a\.yaml is not valid YAML"):
        read_plan(path)


LIMB = Limb.default()
OTHER = other_limb(rest=0.04)


def planned(period, amplitude=0.6, motion="same_direction"):
    given = Motion.named(motion, amplitude=amplitude, period=period, cycles=1)
    return plan(LIMB, given, method="optimal")


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """A motion of 8 s, once after one run and once after two, beside what is no plan."""
    folder, following = tmp_path_factory.mktemp("learned"), planned(8.0)
    learner = Learner(following)
    for run in (1, 2):
        learner.add(following.time, play(following, OTHER))
        following = learner.next()
        write_plan(following, folder / f"run_{run}.yaml")
        os.utime(folder / f"run_{run}.yaml", (run, run))
    (folder / "notes.yaml").write_text("no: plan\n")
    return folder


@pytest.mark.parametrize(("period", "amplitude"), [(9.0, 0.6), (8.0, 0.5)])
def test_a_near_motion_begins_with_less_than_half_of_the_error(library, period, amplitude):
    fresh = planned(period, amplitude)
    file, learned = nearest(library, fresh)
    assert file.name == "run_2.yaml"
    begun = carried_over(fresh, learned)
    assert begun.method == "learned"
    assert begun.period == period
    assert mean_error(begun, play(begun, OTHER)) < 0.5 * mean_error(fresh, play(fresh, OTHER))
    assert np.abs(begun.differential_pressure).max() <= LIMB.pneumatics.pressure_limit


def test_what_is_far_or_of_another_limb_is_not_taken(library):
    assert nearest(library, planned(16.0)) is None
    assert nearest(library, planned(8.0, motion="opposite_direction")) is None
    assert nearest(library, replace(planned(8.0), body=RodModel(OTHER))) is None


@pytest.fixture(scope="module")
def sagging():
    """The same motion with two amplitudes, of a limb that its weight bends unevenly."""
    limb = LIMB.mounted("sideways")
    motions = [Motion.named("asynchronous", size, 8.0, 1) for size in (0.25, 0.28)]
    return [plan(limb, motion, method="projected") for motion in motions]


@pytest.mark.slow
def test_a_sagging_limb_is_not_asked_for_what_evenly_bent_segments_reach(sagging):
    first, _ = sagging
    evenly = first.body.kinematics.tip(first.bend_angles)
    assert mean_error(first, evenly) > 1e-3
    again = Correction(first).plan(first.differential_pressure, np.zeros_like(first.tip_reference))
    assert again.predicted_error < 5e-4


@pytest.mark.slow
def test_near_its_poses_the_tip_of_a_sagging_limb_is_known(sagging):
    first, second = sagging
    near, even = configure(first.body, first.reference).near(first.time), first.body.kinematics
    moved = second.tip_reference - first.tip_reference

    def missed(kinematics):
        told = kinematics.tip(second.bend_angles) - kinematics.tip(first.bend_angles)
        return np.linalg.norm(told - moved, axis=1).mean()

    assert np.linalg.norm(moved, axis=1).mean() > 1e-3
    assert missed(near) < 0.3 * missed(even)


LEAD = 4 * GRID


class Stage:
    """A streamer, what it has sent, and how its plans ended."""

    def __init__(self):
        self.now, self.items, self.ended, self.obstacle = 1_000_000_007, [], [], None
        self.changed = threading.Condition()
        self.streamer = Streamer(lambda: self.now, self.send, self.end, lambda: self.obstacle, LEAD)

    def send(self, schedule, index):
        with self.changed:
            self.items.append((schedule, index))
            self.changed.notify_all()

    def end(self, schedule, outcome, reason):
        with self.changed:
            self.ended.append((schedule.plan_id, outcome))
            self.changed.notify_all()

    def wait(self, condition):
        with self.changed:
            assert self.changed.wait_for(condition, timeout=30.0)

    def move_to(self, instant):
        with self.streamer.lock:
            self.now = instant
            self.streamer.lock.notify_all()

    def send_until(self, schedule, index):
        """Move the clock to the instant at which a setpoint is sent."""
        self.move_to(schedule.stamp(index) - LEAD)
        self.wait(lambda: (schedule, index) in self.items)


@pytest.fixture(scope="module")
def short():
    motion = Motion.named("asynchronous", amplitude=0.4, period=4.0, cycles=1)
    return plan(Limb.default(), motion, "der", "projected")


@pytest.fixture
def stage():
    stage = Stage()
    yield stage
    stage.streamer.close()


def test_first_stamp_is_on_the_grid_and_leaves_time():
    for now in (1, GRID, 7 * GRID - 1, 123456789012):
        stamp = first_stamp(now, LEAD)
        assert stamp % GRID == 0
        assert LEAD <= stamp - now < LEAD + GRID
    assert first_stamp(0, LEAD, wanted=100 * GRID + 1) == 101 * GRID
    assert first_stamp(1000 * GRID, LEAD, wanted=100 * GRID) == 1004 * GRID


def test_every_setpoint_is_sent_once_in_order_and_not_early(stage, short):
    schedule = stage.streamer.play("a", short, 0)
    assert schedule.start % GRID == 0
    stage.send_until(schedule, 30)
    assert [index for _, index in stage.items] == list(range(31))
    stage.send_until(schedule, schedule.count - 1)
    assert [index for _, index in stage.items] == list(range(schedule.count))
    stage.streamer.end_what_is_over()
    assert not stage.ended
    stage.now = schedule.stamp(schedule.count - 1)
    stage.streamer.abandon(Ending("vented", "the run is over"))
    assert stage.ended == [("a", "finished")]
    assert not stage.streamer.is_spent("a")


def test_a_plan_that_begins_in_motion_takes_over_at_its_first_stamp(stage, short):
    first = stage.streamer.play("a", short, 0)
    stage.send_until(first, 20)
    moving = dataclasses.replace(short.reference, start=first.leave(first.stamp(40)))
    following = dataclasses.replace(short, reference=moving)
    second = stage.streamer.play("b", following, first.stamp(40))
    stage.send_until(second, second.count - 1)
    stamps = [schedule.stamp(index) for schedule, index in stage.items]
    assert np.all(np.diff(stamps) == GRID)
    assert [s.plan_id for s, _ in stage.items] == ["a"] * 40 + ["b"] * second.count
    assert stage.ended == [("a", "replaced")]


def test_a_plan_that_begins_at_rest_waits_for_the_end_of_what_is_played(stage, short):
    first, second = (stage.streamer.play(name, short, 0) for name in "ab")
    assert second.start == first.stamp(first.count)
    stage.send_until(second, 0)
    assert stage.items[-2:] == [(first, first.count - 1), (second, 0)]


def test_stop_sends_nothing_more(stage, short):
    first = stage.streamer.play("a", short, 0)
    stage.send_until(first, 5)
    assert stage.streamer.stop("stopped", "")
    second = stage.streamer.play("b", short, 0)
    stage.send_until(second, second.count - 1)
    assert [s.plan_id for s, _ in stage.items] == ["a"] * 6 + ["b"] * second.count
    assert stage.ended == [("a", "stopped")]
    assert not stage.streamer.stop("stopped", "")


def test_a_driver_that_takes_nothing_ends_every_plan_and_spends_their_ids(stage, short):
    first = stage.streamer.play("a", short, 0)
    stage.streamer.play("a-2", short, 0)
    stage.send_until(first, 0)
    stage.obstacle = Ending("fault", "low supply")
    stage.move_to(first.stamp(1))
    stage.wait(lambda: len(stage.ended) == 2)
    assert stage.ended == [("a", "fault"), ("a-2", "fault")]
    assert stage.streamer.is_spent("a")
    assert stage.streamer.unspent("a") == "a-3"


def test_leaving_a_schedule_gives_the_state_there(short):
    schedule = Schedule("a", short, 20 * GRID)
    assert schedule.leave(20 * GRID) is None
    assert schedule.leave(schedule.stamp(schedule.count)) is None
    start = schedule.leave(50 * GRID)
    angles, rate, _ = short.reference.sample(30 * 0.05)
    np.testing.assert_allclose(start.bend_angles, angles)
    np.testing.assert_allclose(start.rate, rate)
    np.testing.assert_array_equal(start.pressure, short.differential_pressure[29])
