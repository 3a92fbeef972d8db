"""The commands on bags, as people call them."""

import json
from pathlib import Path

import pytest
from link_chain import LinkChain
from runs import BagOfRun

from der_planner.bags import recover
from der_planner.commands import evaluate
from der_planner.limb import Limb
from der_planner.planning import Motion, plan

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def experiment(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("experiment")
    for model, error in (("der", 0.002), ("pcc", 0.008)):
        bag = BagOfRun(folder / "bags" / model, run=json.dumps({"trial": 1, "seed": 1}))
        bag.still_run((0.0, error), model=model)
    return folder


def test_evaluate_an_experiment_and_a_bag_that_is_none(call, experiment: Path, tmp_path: Path):
    missing = tmp_path / "missing"
    code, said, complaint = call(evaluate, experiment, missing, "--results", tmp_path)
    assert code == 1
    assert f"error: no bag at {missing}" in complaint
    assert "0.60 cm less error" in said
    document = json.loads((tmp_path / "results.json").read_text())
    errors = {entry["model"]: entry["mean_error_m"] for entry in document["runs"]}
    assert errors == {
        "der": pytest.approx(0.002, abs=5e-5),
        "pcc": pytest.approx(0.008, abs=5e-5),
    }


def test_recover_says_what_it_did(call, experiment: Path):
    bag = experiment / "bags" / "der"
    file = bag / "der_0.mcap"
    file.write_bytes(file.read_bytes()[:-40])
    code, said, complaint = call(recover, bag, bag.parent / "pcc", bag / "missing")
    assert code == 1
    assert f"saved in {bag}_recovered; lost: " in said
    assert "whole, nothing to recover" in said
    assert "missing" in complaint


def test_what_touched_a_recorded_limb_is_told(call, tmp_path: Path):
    planned, chain = plan(Limb.default(), Motion.named("same_direction", 0.3, 6.0, 1)), LinkChain(3)
    planned.limb.to_yaml(tmp_path / "limb.yaml")
    bag = BagOfRun(tmp_path / "bag", run=json.dumps({"trial": 1, "seed": 1}))
    names = ("differential_pressure", "tip_reference", "tip_predicted")
    arrays = {name: getattr(planned, name).ravel() for name in names}
    bag.plan(time=planned.time, amplitude=0.3, period=6.0, cycles=1, **arrays)
    for index, command in enumerate(planned.differential_pressure):
        when = float(planned.time[index])
        chain.push(0.244, (0.0, 0.5 if when > 5.0 else 0.0))
        seen = chain.seen()
        bag.setpoint(index, command)
        bag.pressure(when, command, seen.differential_pressure)
        bag.state(when, seen.tip, bend=seen.bend_angles)
        chain.advance(command, 0.05)
    bag.bag.close()
    limb = ("--limb", tmp_path / "limb.yaml")
    code, said, complaint = call(evaluate, tmp_path / "bag", "--contact", *limb)
    assert code == 0, complaint
    assert "touched from 5." in said
