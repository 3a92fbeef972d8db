"""The experiment's command line: what is refused, and what order trials are played in."""

from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def parse():
    from der_planner.experiment.options import parse

    return parse


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--motions", "sideways"], "sideways"),
        (["--models", "der", "cosserat"], "cosserat"),
        (["--method", "guess"], "guess"),
        (["--trials", "0"], "--trials"),
        (["--period", "0.1"], "--period"),
        (["--hardware", "/nowhere/rig.yaml"], "/nowhere/rig.yaml"),
    ],
)
def test_a_bad_option_is_refused_by_its_name(parse, arguments, named):
    from der_planner.experiment.options import OptionError

    with pytest.raises(OptionError, match=named):
        parse(arguments)


def test_hardware_without_its_serial_device_is_refused(parse, tmp_path: Path):
    from der_planner.experiment.options import OptionError

    rig = tmp_path / "rig.yaml"
    rig.write_text("driver: {port: /dev/serial/by-id/no-such-board}\nlimb: limb.yaml\n")
    with pytest.raises(OptionError, match="no-such-board"):
        parse(["--hardware", str(rig)])
    rig.write_text("pump: {}\n")
    with pytest.raises(OptionError, match="unknown key 'pump'"):
        parse(["--hardware", str(rig)])


def test_trials_share_seeds_between_models_and_differ_between_trials(parse):
    trials = parse(["--motions", "all", "--trials", "2", "--seed", "7"]).plan_of_trials()
    assert len(trials) == 3 * 2 * 2
    assert {trial.seed for trial in trials if trial.number == 1} == {7}
    assert {trial.seed for trial in trials if trial.number == 2} == {8}
    assert len({trial.name for trial in trials}) == len(trials)


def test_pcc_is_always_planned_by_its_own_method(parse):
    trials = parse(["--method", "optimal"]).plan_of_trials()
    assert [(trial.model, trial.method) for trial in trials] == [
        ("der", "optimal"),
        ("pcc", "paper"),
    ]


def test_a_stopped_experiment_goes_on_and_refuses_other_options(parse, tmp_path: Path):
    from der_planner.experiment.ledger import Ledger
    from der_planner.experiment.options import OptionError

    arguments = ["--out", str(tmp_path), "--trials", "2"]
    options = parse(arguments)
    first, second = options.plan_of_trials()[:2]
    Ledger(options).record(first, {"bag": "somewhere"})
    again = Ledger(parse(arguments))
    assert again.finished(first) == {"bag": "somewhere"}
    assert again.finished(second) is None
    with pytest.raises(OptionError, match=r"period = 20\.0, not 6\.0"):
        Ledger(parse([*arguments, "--period", "6"])).finished(first)
