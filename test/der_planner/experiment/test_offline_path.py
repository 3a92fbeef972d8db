"""A path is drawn offline, open loop and with feedback: from the file to the report."""

import json
from pathlib import Path

import numpy as np
import pytest

from der_planner.commands.run_experiment import run
from der_planner.experiment.options import parse


@pytest.mark.slow
def test_a_nearest_path_is_drawn_with_and_without_feedback_and_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    file = tmp_path / "line.csv"
    file.write_text("time [s], x [cm], y [cm]\n0, 22, 8\n8, 24, 10\n")
    arguments = ["--offline", "--no-calibration", "--models", "der", "--feedback", "--seed", "3"]
    arguments += ["--path", str(file), "--nearest", "--out", str(tmp_path / "out")]
    run(parse(arguments))
    alone, corrected = json.loads((tmp_path / "out" / "results.json").read_text())["runs"]
    assert (alone["method"], corrected["method"]) == ("optimal", "optimal + feedback")
    assert (alone["motion"], alone["model"], alone["cycles"]) == ("line, nearest path", "der", 1)
    assert alone["extra"]["drawn_path_m"] == [[0.22, 0.08], [0.24, 0.1]]
    assert 0.0 < alone["mean_error_m"] < 0.05
    assert corrected["mean_error_m"] < 0.75 * alone["mean_error_m"]
    assert max(corrected["extra"]["feedback"]["correction_rms_pa"]) > 100.0
    played = np.load(tmp_path / "out" / "runs" / "line_der_optimal_trial1.npz")
    begins = np.linalg.norm(played["tip_reference"] - [0.22, 0.08], axis=1)
    assert begins.min() < 1e-3
    page = (tmp_path / "out" / "report" / "report.html").read_text()
    assert str(file) in page
    assert "What feedback added" in page
    for text in (page, capsys.readouterr().out):
        assert "the reference is the nearest path in reach, not the drawn one" in text
