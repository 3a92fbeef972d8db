"""Runs read from bags: ours, rosbags' own, split and killed ones."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from runs import FRAMES, TIMES, BagOfRun, reference

from der_planner.identification import read_bag
from der_planner.results import (
    BagError,
    EvaluationError,
    evaluate_bags,
    evaluate_run,
    format_table,
    load_run,
    summarise,
)

HUNG = {"gravity": np.array([9.81, 0.0, 0.0]), "payload": 0.02, "payload_at": 0.244}
OFFSET = np.array([0.003, -0.004])


def write_run(bag: BagOfRun, first_setpoint: float = 0.0, valves=range(4)) -> None:
    """Write a run in which the tip is off by 5 mm, in the order of time."""
    bag.plan(stamp=first_setpoint)
    events = [(TIMES[i], "setpoint", i) for i in range(len(TIMES))]
    events += [(t, "state", t) for t in FRAMES]
    for when, kind, what in sorted(events, key=lambda event: event[0]):
        if kind == "setpoint":
            value = 3000.0 * np.array([np.sin(when), np.cos(when)])
            bag.setpoint(what, value)
            bag.pressure(when, value, value + np.array([100.0, -50.0]))
            bag.command(when + 0.004, value, what, valves)
        else:
            bag.state(when, reference(when)[0] + OFFSET)
            bag.state(
                when, reference(when)[0] + OFFSET - [0.0003, 0.0], topic="/limb/twin/ground_truth"
            )


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "run"
    run = json.dumps({"trial": 2, "seed": 7, "commit": "abc"})
    bag = BagOfRun(path, run=run)
    write_run(bag)
    bag.bag.close()
    return path


def test_run_of_a_bag(folder: Path):
    result = evaluate_run(load_run(folder))
    assert result.mean_error_m == pytest.approx(0.005, abs=3e-5)
    assert (result.motion, result.model, result.method) == ("same_direction", "der", "paper")
    assert (result.trial, result.seed, result.limb) == (2, 7, "test limb")
    assert result.extra == {"commit": "abc"}
    assert result.bag == str(folder)
    assert result.problems == ()
    assert result.pressure_rms_error_pa == pytest.approx((100.0, 50.0))
    assert result.checks["tracker_rms_m"] == pytest.approx(0.0003, rel=1e-3)
    assert result.checks["board_lost"] == 0
    assert result.checks["board_received"] == len(TIMES)
    assert result.checks["board_lateness_p99_s"] == pytest.approx(0.004, abs=1e-6)
    assert result.checks["board_value_error_pa"] <= 100.0


def test_a_board_with_crossed_hoses_receives_every_setpoint(tmp_path: Path):
    bag = BagOfRun(tmp_path / "run", run=json.dumps({"wiring": [2, 0, 3, 1]}))
    write_run(bag, valves=(2, 0, 3, 1))
    assert evaluate_run(load_run(bag.bag.close())).checks["board_lost"] == 0


def test_times_come_from_the_setpoints_not_from_arrival_or_plan(tmp_path: Path):
    bag = BagOfRun(tmp_path / "run")
    write_run(bag, first_setpoint=-3.0)  # the plan's own stamp is off by 3 s
    assert evaluate_run(load_run(bag.bag.close())).mean_error_m == pytest.approx(0.005, abs=3e-5)


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_bag_in_rosbags_own_layout_evaluates_the_same(folder: Path, tmp_path: Path, storage):
    from rosbags.rosbag2 import Reader

    copy = tmp_path / "copy"
    with Reader(folder) as source, Writer(copy, version=9, storage_plugin=storage) as target:
        made = {
            c.id: target.add_connection(c.topic, c.msgtype, msgdef=c.msgdef.data, rihs01=c.digest)
            for c in source.connections
        }
        for connection, when, data in source.messages(source.connections):
            target.write(made[connection.id], when, data)
    one, two = asdict(evaluate_run(load_run(folder))), asdict(evaluate_run(load_run(copy)))
    for key in ("bag", "trial", "seed", "extra"):
        one.pop(key)
        two.pop(key)
    assert one == two


def test_clocks_that_are_off_are_named_in_the_report(tmp_path: Path):
    bag = BagOfRun(tmp_path / "run")
    pairs = {"clock_offset_s": "-0.030000", "clock_uncertainty_s": "0.000200"}
    told = [
        bag.make("diagnostic_msgs/msg/KeyValue", key=key, value=value)
        for key, value in pairs.items()
    ]
    silent = bag.make("diagnostic_msgs/msg/DiagnosticStatus")
    status = [replace(silent, name="/limb/tracker", values=told), replace(silent, values=told[:1])]
    bag.write("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", 0.0, status=status)
    bag.travel = -0.025
    result = evaluate_run(load_run(bag.still_run()))
    assert result.extra == {"clocks": "/limb/tracker +30.00 ± 0.20 ms"}
    assert result.problems == ("stamps come from up to 25 ms in the future: see `clocks`",)


def test_what_was_not_yet_measured_is_left_out(tmp_path: Path):
    bag = BagOfRun(tmp_path / "run")
    bag.pressure(-0.2, [], [])
    bag.plan()
    for index in range(len(TIMES)):
        bag.setpoint(index, [0.0, 0.0])
        measured = [] if index < 10 else [200.0, 300.0]
        bag.pressure(TIMES[index], [100.0, 100.0], measured)
    for index, when in enumerate(FRAMES):
        bag.state(when, reference(when)[0], valid=index != 50)
    run = load_run(bag.bag.close())
    assert np.isnan(run.measured.value[:11]).all()
    assert np.isnan(run.bend_angle.value[50]).all()
    assert np.allclose(np.delete(run.bend_angle.value, 50, axis=0), [0.1, 0.2])
    result = evaluate_run(run)
    assert result.pressure_rms_error_pa == pytest.approx((100.0, 200.0))
    assert 0.99 < result.valid_fraction < 1.0


def test_interrupted_run_says_so(tmp_path: Path):
    bag = BagOfRun(tmp_path / "run")
    bag.plan()
    for index in range(40):
        bag.setpoint(index, [0.0, 0.0])
    for when in FRAMES[FRAMES < 2.0]:
        bag.state(when, reference(when)[0])
    bag.pressure(1.5, [0, 0], [0, 0], mode=5, faults=["serial line lost"])
    for when, distance, said in ((0.9, 2.0, "0.2 N"), (1.0, 9.0, "0.3 N"), (1.1, 4.0, "0.4 N")):
        bag.touch(when, 0.8, distance, said)
    result = evaluate_run(load_run(bag.bag.close()))
    assert any("serial line lost" in text for text in result.problems)
    touched = [text for text in result.problems if "touched" in text]
    assert touched == ["something touched the limb from 0.80 s on, 0.3 N"]
    assert any("end before the motion" in text for text in result.problems)


def test_bag_without_plan_or_states_is_refused(tmp_path: Path):
    bag = BagOfRun(tmp_path / "no_plan")
    bag.state(0.0, (0.2, 0.0))
    bag.bag.close()
    with pytest.raises(EvaluationError, match=r"no_plan: holds no der_msgs/msg/PressurePlan"):
        load_run(tmp_path / "no_plan")
    bag = BagOfRun(tmp_path / "no_state")
    bag.plan()
    bag.setpoint(0, [0.0, 0.0])
    bag.bag.close()
    with pytest.raises(EvaluationError, match="see whether the tracker ran"):
        load_run(tmp_path / "no_state")
    bag = BagOfRun(tmp_path / "elsewhere")
    bag.plan()
    bag.state(0.0, (0.2, 0.0), topic="/camera/state")
    bag.bag.close()
    with pytest.raises(EvaluationError, match="states in /camera, where no plan is: remap them"):
        load_run(tmp_path / "elsewhere", namespace="/limb")


def test_a_plan_of_others_needs_a_reference_and_no_prediction(tmp_path: Path):
    BagOfRun(tmp_path / "run").still_run(OFFSET, tip_predicted=np.zeros(0))
    result = evaluate_run(load_run(tmp_path / "run"))
    assert result.mean_error_m == pytest.approx(0.005, abs=3e-5)
    assert np.isnan(result.predicted_error_m)
    BagOfRun(tmp_path / "short").still_run(OFFSET, tip_reference=np.zeros(4))
    with pytest.raises(EvaluationError, match="tip_reference must have shape"):
        load_run(tmp_path / "short")


def test_the_plan_that_was_played_is_chosen(tmp_path: Path):
    bag = BagOfRun(tmp_path / "run")
    bag.plan(plan_id="rejected", model="pcc", stamp=-5.0)
    write_run(bag)
    bag.bag.close()
    assert load_run(tmp_path / "run").description.model == "der"
    assert load_run(tmp_path / "run", plan_id="rejected").description.model == "pcc"
    with pytest.raises(EvaluationError, match="only p, rejected"):
        load_run(tmp_path / "run", plan_id="none")


def two_limbs(folder: Path, **offsets) -> None:
    """Write one bag with runs of ``/limb`` and ``/lab2``, each with its own constant error [m].

    A limb without an offset has a plan and setpoints, but its camera saw nothing.
    """
    first = BagOfRun(folder)
    limbs = {"limb": first, "lab2": BagOfRun(folder, first.bag, namespace="/lab2")}
    for name, bag in limbs.items():
        bag.plan(plan_id=name)
        for index in range(len(TIMES)):
            bag.setpoint(index, [0.0, 0.0], plan_id=name)
            bag.pressure(TIMES[index], [100.0, 100.0], [200.0, 300.0])
        for when in FRAMES if name in offsets else ():
            bag.state(when, reference(when)[0] + [0.0, offsets[name]])
            bag.state(when, reference(when)[0], topic="/limb/twin/ground_truth")
    first.bag.close()


def test_two_limbs_in_one_bag_are_evaluated_apart(tmp_path: Path):
    two_limbs(tmp_path / "run", limb=0.002, lab2=0.008)
    found = list(evaluate_bags([tmp_path / "run"]))
    errors = {entry.result.namespace: entry.result.mean_error_m for entry in found}
    assert errors == {
        "/limb": pytest.approx(0.002, abs=5e-5),
        "/lab2": pytest.approx(0.008, abs=5e-5),
    }
    checks = {entry.result.namespace: entry.result.checks["tracker_rms_m"] for entry in found}
    assert checks["/limb"] == pytest.approx(0.002, abs=5e-5)
    assert checks["/lab2"] == pytest.approx(0.008, abs=5e-5)
    rows = summarise([entry.result for entry in found])
    assert [row.trials for row in rows] == [1, 1]
    text = format_table(rows)
    assert "/limb" in text
    assert "/lab2" in text


def test_a_plan_never_meets_the_state_of_another_limb(tmp_path: Path):
    two_limbs(tmp_path / "run", lab2=0.008)
    (seen,) = [entry for entry in evaluate_bags([tmp_path / "run"]) if entry.result]
    assert seen.result.namespace == "/lab2"
    (blind,) = [entry for entry in evaluate_bags([tmp_path / "run"]) if entry.error]
    assert "/limb: no limb state was recorded" in blind.error


def test_a_run_among_several_limbs_is_named(tmp_path: Path):
    two_limbs(tmp_path / "run", limb=0.002, lab2=0.008)
    with pytest.raises(BagError, match=r"several limbs, /lab2, /limb: name one"):
        load_run(tmp_path / "run")
    assert load_run(tmp_path / "run", plan_id="lab2").description.namespace == "/lab2"
    with pytest.raises(BagError, match=r"no limb /lab3, only /lab2, /limb"):
        load_run(tmp_path / "run", namespace="/lab3")
    log = read_bag(tmp_path / "run", namespace="/lab2")  # as a calibration reads it
    assert np.nanmax(np.abs(log.tip - reference(log.time + TIMES[0]) - [0.0, 0.008])) < 1e-3
    assert np.allclose(log.measured_differential, [200.0, 300.0])


def test_loads_of_a_bag_are_those_of_its_plan(tmp_path: Path):
    result = evaluate_run(load_run(BagOfRun(tmp_path / "hung").still_run(**HUNG)))
    assert (result.mounting, result.gravity_m_s2) == ("hanging", (9.81, 0.0, 0.0))
    assert (result.payload_kg, result.payload_at_m) == (0.02, 0.244)
    assert "hanging, 20 g at 24.4 cm" in format_table(summarise([result]))


def test_the_last_revision_of_a_setpoint_counts(tmp_path: Path):
    bag = BagOfRun(tmp_path / "run")
    bag.plan()
    for index, time in enumerate(TIMES):
        for revision, pressure in enumerate((1000.0, 1200.0, 1500.0)):
            bag.setpoint(index, [pressure, -pressure], revision=revision)
        bag.pressure(time, [1500.0, -1500.0], [1500.0, -1500.0])
        bag.command(time + 0.004, [1500.0, -1500.0], index)
        bag.state(time + 0.01, reference(time + 0.01)[0])
    result = evaluate_run(load_run(bag.bag.close()))
    assert result.checks["board_lost"] == 0
    assert result.extra["feedback"]["correction_max_pa"] == [1500.0, 1500.0]
