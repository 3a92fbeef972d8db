"""Learning within an experiment, offline: a line a run, a curve in results and report."""

import json
from pathlib import Path

import pytest

from der_planner.commands.run_experiment import run
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
    assert (tmp_path / "report/learning.png").stat().st_size > 5000
    assert "runs that a plan was learned from" in (tmp_path / "report/report.html").read_text()
    (kept,) = tmp_path.glob("learned/same_direction_der_trial1.yaml")
    assert read_plan(kept).method == "learned"
    near = tmp_path / "near"
    library = ["--library", str(tmp_path / "learned"), "--learn", "1"]
    run(options(near, "--period", "4.4", "--no-report", *library))
    assert "begins from what was learned in" in capsys.readouterr().err
    begun, learned = json.loads((near / "results.json").read_text())["runs"]
    assert begun["mean_error_m"] < 0.8 * errors[0]
    assert begun["method"] == "learned"
    assert learned["method"] == "learned 1"
