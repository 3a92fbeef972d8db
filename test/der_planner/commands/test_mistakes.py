"""Mistakes on command lines end with a sentence and an exit code, never with a traceback."""

import fcntl
import importlib
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from der_planner.commands import calibrate_limb, run_experiment, study
from der_planner.experiment.processes import find_executable
from der_planner.limb import Limb

SCRIPTS = Path(__file__).resolve().parents[3] / "scripts"


LENS = ["intrinsics", "--out", "/tmp/never_written.yaml"]
STANDING = ["--mounting", "standing", "--out", "/tmp/never_written.yaml"]


@pytest.mark.parametrize(
    ("module", "arguments", "code", "words"),
    [
        ("der_planner.commands.evaluate", ["b", "--report", "BUSY"], 2, "cannot be made"),
        ("der_planner.commands.evaluate", ["b", "--contact"], 2, "--limb FILE or --plan FILE"),
        ("der_planner.commands.calibrate_limb", ["--offline", "--out", "BUSY"], 2, "no folder"),
        ("der_planner.commands.calibrate_limb", ["--offline", "--out", "."], 2, "is a folder"),
        ("der_planner.commands.calibrate_limb", ["--excitation", "BUSY"], 2, "no folder"),
        (
            "der_planner.commands.calibrate_limb",
            [*STANDING, "/none.csv", "--columns", "/none.yaml"],
            1,
            "which neither rod nor arcs predict. Hang it",
        ),
        ("apriltag_tracker.commands.make_tags", ["board", "--out", "BUSY"], 1, "out"),
        ("apriltag_tracker.commands.make_tags", ["board", "--columns", "2"], 1, "3 or more"),
        ("apriltag_tracker.commands.make_tags", ["board", "--marker", "0.03"], 1, "do not fit"),
        ("apriltag_tracker.commands.calibrate_camera", [*LENS, "--rows", "2"], 1, "3 or more"),
        ("apriltag_tracker.commands.calibrate_camera", [*LENS, "--bag", __file__], 1, "the bag"),
        ("der_planner.commands.run_experiment", ["--dry-run", "--out", "BUSY"], 2, "cannot be"),
        ("der_planner.commands.run_experiment", ["--limb", __file__], 2, "is not valid YAML"),
        (
            "der_planner.commands.run_experiment",
            ["--dry-run", "--period", "600", "--cycles", "1000"],
            1,
            "are longer than",
        ),
        (
            "der_planner.commands.run_experiment",
            ["--dry-run", "--no-calibration", "--amplitude", "1.7"],
            1,
            "is out of reach",
        ),
        ("der_planner.commands.study", ["accuracy", "--out", "BUSY"], 1, "cannot write into"),
        ("benchmarks.command", ["rod", "--json", "BUSY"], 2, "no folder"),
    ],
)
def test_mistakes_are_said_before_any_work_is_done(call, tmp_path, module, arguments, code, words):
    """BUSY is a path below a file."""
    (tmp_path / "file").write_text("in the way")
    busy = tmp_path / "file" / "out"
    line = [busy if word == "BUSY" else word for word in arguments]
    found, _, said = call(importlib.import_module(module), *line)
    assert found == code
    assert "error: " in said
    assert words in said


def test_a_dry_run_plans_the_path_and_names_a_twin_that_the_limb_file_is_not_of(call, tmp_path):
    path, limb = tmp_path / "path.csv", tmp_path / "limb.yaml"
    path.write_text("x [cm], y [cm]\n20, 10\n26, 10\n")
    replace(Limb.default(), provenance={"source": "twin, seed 3, run 1"}).to_yaml(limb)
    given = ("--dry-run", "--limb", str(limb), "--path", str(path))
    found, _, said = call(run_experiment, *given)
    assert (found, "nearest=True; --nearest" in said) == (1, True)
    found, _, said = call(run_experiment, *given, "--nearest")
    assert (found, "of the twin of seed 3, trials play on twins from seed 1 on" in said) == (
        0,
        True,
    )
    found, _, said = call(run_experiment, *given, "--nearest", "--seed", "3")
    assert (found, "warning" in said) == (0, False)


def test_a_limb_unlike_the_twin_does_not_play_on_it(call, tmp_path):
    segment, file = Limb.default().segments[0], tmp_path / "limb.yaml"
    for segments in ((segment,), (replace(segment, length=0.04),) * 2):
        replace(Limb.default(), segments=segments).to_yaml(file)
        found, _, said = call(run_experiment, "--dry-run", "--limb", str(file))
        assert (found, "the twin has 2 segments and 0.244 m" in said) == (1, True)


@pytest.mark.parametrize("words", [(run_experiment, "--offline"), (study, "accuracy")])
def test_two_runs_of_a_command_do_not_share_a_folder(call, tmp_path, words):
    with (tmp_path / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        found, _, said = call(*words, "--out", str(tmp_path))
    assert (found, "is in use by another run" in said) == (2, True)


def test_pressures_beyond_the_limit_start_nothing(call, tmp_path):
    table, out = tmp_path / "excitation.csv", str(tmp_path / "limb.yaml")
    table.write_text("time_s,a,b\n0,0,0\n0.05,0,30000\n")
    words = ("--graph", "--play", str(table), "--folder", str(tmp_path / "run"), "--out", out)
    found, _, said = call(calibrate_limb, *words)
    assert (found, (tmp_path / "run").exists()) == (1, False)
    assert "asks for 30000 Pa, the limit is ±24000 Pa" in said


@pytest.mark.slow
def test_a_missing_parameter_file_is_named_by_the_node():
    node = str(find_executable("der_planner", "planner"))
    ended = subprocess.run(
        [node, "--ros-args", "--params-file", "/nowhere/planner.yaml"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 1
    assert "/nowhere/planner.yaml" in ended.stderr
    assert "Traceback" not in ended.stderr
