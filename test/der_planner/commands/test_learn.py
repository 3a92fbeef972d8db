"""scripts/learn.py: from bags to the next plan, and what it refuses."""

import numpy as np
import pytest
from runs import BagOfRun

from der_planner.commands import learn
from der_planner.limb import Limb
from der_planner.planning import Motion, plan
from der_planner.planning.plan_file import read_plan, write_plan

SHIFT = np.array([0.0, 2e-3])


@pytest.fixture(scope="module")
def planned():
    motion = Motion.named("same_direction", amplitude=0.4, period=4.0, cycles=1)
    return plan(Limb.default(), motion, method="optimal")


def write_bag(folder, planned, shift):
    bag = BagOfRun(folder)
    bag.plan(
        amplitude=planned.amplitude, period=planned.period, cycles=planned.cycles,
        time=planned.time, differential_pressure=planned.differential_pressure.ravel(),
        tip_reference=planned.tip_reference.ravel(), tip_predicted=planned.tip_predicted.ravel(),
    )  # fmt: skip
    for time in np.arange(-0.5, planned.time[-1] + 0.5, 1 / 30):
        row = [np.interp(time, planned.time, axis) for axis in planned.tip_predicted.T]
        bag.state(time, np.array(row) + shift, valid=not 2.0 < time < 2.3)
    bag.bag.close()


def test_two_bags_become_the_next_plan(planned, tmp_path, call):
    Limb.default().to_yaml(tmp_path / "limb.yaml")
    for number in (1, 2):
        write_bag(tmp_path / f"bag{number}", planned, number * SHIFT / 1.5)
    out = tmp_path / "learned.yaml"
    bags = [tmp_path / "bag1", tmp_path / "bag2"]
    code, said, _ = call(learn, *bags, "--limb", tmp_path / "limb.yaml", "--out", out)
    assert (code, said.count("mean error")) == (0, 3)
    # What the limb did too far to the left on average, the model is asked to do to the right.
    following = read_plan(out)
    assert following.method == "learned"
    seen = slice(40, 70)
    model_tip = following.tip_predicted - following.tip_reference
    assert np.abs(model_tip[seen]).max() < 4e-4
    change = following.differential_pressure - planned.differential_pressure
    assert change[seen, 0].sum() < 0
    again = tmp_path / "again.yaml"
    assert call(learn, tmp_path / "bag1", "--plan", out, "--out", again)[0] == 0
    assert np.isfinite(read_plan(again).differential_pressure).all()


def test_what_cannot_be_learned_is_said(planned, tmp_path, call):
    write_bag(tmp_path / "bag", planned, SHIFT)
    motion = Motion.named("asynchronous", amplitude=0.4, period=4.0, cycles=1)
    write_plan(plan(Limb.default(), motion, method="projected"), tmp_path / "other.yaml")
    for arguments, said in (
        (("--plan", tmp_path / "other.yaml", "--out", tmp_path / "o.yaml"), "another motion"),
        (("--plan", tmp_path / "none.yaml", "--out", tmp_path / "o.yaml"), "cannot read the plan"),
        (("--plan", tmp_path / "other.yaml", "--out", tmp_path), "is a folder: name a file"),
    ):
        code, _, complaint = call(learn, tmp_path / "bag", *arguments)
        assert code == 2
        assert said in complaint
