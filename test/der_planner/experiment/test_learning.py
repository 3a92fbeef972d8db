"""Learning within an experiment, offline: a line a run, a curve in results and report."""

import json
from pathlib import Path

import numpy as np
import pytest

from der_planner.commands.run_experiment import run
from der_planner.experiment.console import OptionError
from der_planner.experiment.options import parse
from der_planner.planning.plan_file import read_plan


def options(out: Path, *more: str):
    short = ["--period", "4", "--cycles", "1", "--amplitude", "0.3", "--models", "der"]
    return parse(["--offline", "--no-calibration", *short, "--out", str(out), *more])


@pytest.mark.slow
def test_runs_are_learned_from_and_a_stopped_experiment_goes_on(tmp_path: Path, capsys):
    run(options(tmp_path, "--learn", "1", "--no-report"))
    run(options(tmp_path, "--learn", "2"))
    said = capsys.readouterr().err
    assert said.count("run 1: mean error") == 2
    assert "run 3: mean error" in said
    document = json.loads((tmp_path / "results.json").read_text())
    methods = [result["method"] for result in document["runs"]]
    assert methods == ["optimal", "learned 1", "learned 2"]
    errors = [result["mean_error_m"] for result in document["runs"]]
    assert errors[2] < 0.7 * errors[0], errors
    assert (tmp_path / "learning.png").exists()
    assert "runs that a plan was learned from" in (tmp_path / "report/report.html").read_text()
    (kept,) = tmp_path.glob("learned/same_direction_der_trial1.yaml")
    played = np.load(tmp_path / "runs" / "same_direction_der_learned_trial1_run2.npz")
    first = read_plan(tmp_path / "learned" / "same_direction_der_learned_trial1_run2.yaml")
    assert np.array_equal(played["differential_pressure"], first.differential_pressure)
    assert read_plan(kept).method == "learned"
    near = tmp_path / "near"
    given = parse(
        [
            *("--offline", "--no-calibration", "--period", "4.4", "--cycles", "1"),
            *("--amplitude", "0.3", "--models", "der", "--no-report", "--out", str(near)),
            *("--library", str(tmp_path / "learned"), "--learn", "1"),
        ]
    )
    run(given)
    assert "begins from what was learned in" in capsys.readouterr().err
    begun, learned = json.loads((near / "results.json").read_text())["runs"]
    assert begun["mean_error_m"] < 0.8 * errors[0]
    assert begun["method"] == "learned"
    assert learned["method"] == "learned 1"


def test_what_cannot_be_learned_from_is_refused(tmp_path: Path):
    with pytest.raises(OptionError, match="is no folder"):
        options(tmp_path, "--library", str(tmp_path / "none"))
    with pytest.raises(OptionError, match="--learn is -1"):
        options(tmp_path, "--learn", "-1")
