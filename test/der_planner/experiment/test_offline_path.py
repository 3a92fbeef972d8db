"""A path is drawn offline: from the file to the report."""

import json
from pathlib import Path

import numpy as np
import pytest

from der_planner.commands.run_experiment import run
from der_planner.experiment.options import parse


def write_arc(file: Path) -> None:
    """Write a timed arc at the reach of the default limb, in cm."""
    angle = np.linspace(0.46, 0.56, 13)
    rows = [
        f"{time:.2f}, {22.4 * np.cos(a):.4f}, {22.4 * np.sin(a):.4f}"
        for time, a in zip(np.linspace(0, 6, 13), angle, strict=True)
    ]
    file.write_text("\n".join(["time [s], x [cm], y [cm]", *rows]) + "\n")


@pytest.mark.slow
def test_a_path_is_drawn_and_reported(tmp_path: Path):
    file = tmp_path / "arc.csv"
    write_arc(file)
    out = tmp_path / "out"
    arguments = ["--offline", "--no-calibration", "--models", "pcc", "--path", str(file)]
    run(parse([*arguments, "--out", str(out)]))
    (result,) = json.loads((out / "results.json").read_text())["runs"]
    assert (result["motion"], result["model"], result["cycles"]) == ("arc", "pcc", 1)
    assert 0.0 < result["mean_error_m"] < 0.05
    played = np.load(out / "runs" / "arc_pcc_optimal_trial1.npz")
    start, end = 0.224 * np.array([[np.cos(a), np.sin(a)] for a in (0.46, 0.56)])
    for point in (start, end):
        assert np.linalg.norm(played["tip_reference"] - point, axis=1).min() < 1e-3
    page = (out / "report" / "report.html").read_text()
    assert "arc" in page
    assert str(file) in page


@pytest.mark.slow
def test_results_of_a_nearest_path_say_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "line.csv"
    file.write_text("x [cm], y [cm]\n22, 8\n24, 10\n")
    arguments = ["--offline", "--no-calibration", "--models", "pcc", "--path", str(file)]
    run(parse([*arguments, "--nearest", "--out", str(tmp_path / "out")]))
    (result,) = json.loads((tmp_path / "out" / "results.json").read_text())["runs"]
    assert result["motion"] == "line, nearest path"
    assert result["extra"]["drawn_path_m"] == [[0.22, 0.08], [0.24, 0.1]]
    page = (tmp_path / "out" / "report" / "report.html").read_text()
    for text in (page, capsys.readouterr().out):
        assert "the reference is the nearest path in reach, not the drawn one" in text


@pytest.mark.slow
def test_feedback_stands_beside_the_open_loop(tmp_path: Path):
    arguments = ["--offline", "--no-calibration", "--models", "der", "--feedback", "--seed", "3"]
    arguments += ["--period", "12", "--cycles", "1"]
    run(parse([*arguments, "--out", str(tmp_path)]))
    runs = json.loads((tmp_path / "results.json").read_text())["runs"]
    found = {result["method"]: result for result in runs}
    alone, corrected = found["optimal"], found["optimal + feedback"]
    assert corrected["mean_error_m"] < 0.75 * alone["mean_error_m"]
    assert max(corrected["extra"]["feedback"]["correction_rms_pa"]) > 100.0
    assert "What feedback added" in (tmp_path / "report" / "report.html").read_text()
