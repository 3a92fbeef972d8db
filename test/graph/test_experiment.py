"""The main command from the outside: whole runs, and what is left of one that is interrupted."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from domain import own_domain

from der_planner.experiment.processes import GraphSetup
from der_planner.limb import CalibratedRange, Limb, gravity_of
from der_planner.planning.plan_file import read_plan
from der_planner.results import load_run

ROOT = Path(__file__).resolve().parent.parent.parent
TWIN_NODES = {node.executable for node in GraphSetup(Path(), {}, planner={}).nodes("")}
pytestmark = pytest.mark.graph


class Experiment:
    """A run_experiment.py in a process and a ROS domain of its own."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self.out = folder / "out"
        self.mark = {"TEST_EXPERIMENT": str(folder)}
        self._process = subprocess.Popen(
            [
                *(sys.executable, ROOT / "scripts" / "run_experiment.py", "--out", self.out),
                *("--no-calibration", "--method", "paper", "--period", "3", "--cycles", "1"),
                *arguments,
            ],
            env={**os.environ, "ROS_DOMAIN_ID": str(own_domain(__file__)), **self.mark},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.output = ""
        self.errors = ""

    def finish(self, timeout: float = 400.0) -> int:
        self.output, rest = self._process.communicate(timeout=timeout)
        self.errors += rest
        return self._process.returncode

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    def wait_for_line(self, text: str) -> None:
        """Wait until the run says something on stderr."""
        for line in self._process.stderr:
            self.errors += line
            if text in line:
                return
        raise AssertionError(f"never said {text!r}:\n{self.errors}")

    def processes(self) -> dict[str, int]:
        """Return the process ids of this run's nodes by the name of their executable."""
        found = {}
        for process in psutil.process_iter(["cmdline", "environ"]):
            if self.mark.items() <= (process.info["environ"] or {}).items():
                words = {Path(word).name for word in process.info["cmdline"] or ()}
                found |= dict.fromkeys(words & TWIN_NODES, process.pid)
        return found

    def close(self) -> None:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            self._process.communicate(timeout=60)


@pytest.fixture
def experiment(tmp_path: Path) -> Iterator:
    running = []

    def start(*arguments: str) -> Experiment:
        running.append(Experiment(tmp_path, *arguments))
        return running[-1]

    yield start
    for each in running:
        each.close()


def last_board_command(bag: Path) -> np.ndarray:
    """Return the differential pressures [Pa] that the board was told last, as the bag has it."""
    from der_planner.bags.reader import BagReader

    last = None
    with BagReader(bag) as reader:
        for _, _, message in reader.messages(["/limb/twin/board_commands"]):
            last = message
    assert last is not None, f"{bag} holds no command that the board received"
    pressure = np.array(last.pressure)
    return pressure[0::2] - pressure[1::2]


def test_an_interrupted_experiment_with_loads_and_feedback_vents_and_goes_on(experiment, tmp_path):
    known = CalibratedRange((2e4, 2e4), (1.5, 1.5))
    dataclasses.replace(Limb.default(), calibrated=known).to_yaml(tmp_path / "level.yaml")
    words = (
        *("--models", "der", "--feedback", "--limb", tmp_path / "level.yaml"),
        *("--mounting", "20", "--payload", "0.02", "--amplitude", "0.3", "--period", "7"),
    )
    run = experiment(*words)
    run.wait_for_line("planned in")
    run.wait_for_line("planned in")
    assert set(run.processes()) == TWIN_NODES
    run.signal(signal.SIGINT)
    assert run.finish() == 130
    assert "warning: the mounting is 20°, the limb was calibrated as horizontal" in run.errors
    assert "the same --out goes on" in run.errors
    assert_vented_and_closed(run, "same_direction_der_paper_feedback_trial1")

    again = experiment(*words)
    assert again.finish() == 0, again.errors
    assert "1 of 2 trials to play" in again.errors
    assert (run.out / "stopped" / "same_direction_der_paper_feedback_trial1_1").exists()
    assert "20°, 20 g" in again.output
    entries = json.loads((run.out / "results.json").read_text())["runs"]
    assert [entry["method"] for entry in entries] == ["paper", "paper + feedback"]
    for entry in entries:
        assert entry["mounting"] == "20°"
        np.testing.assert_allclose(entry["gravity_m_s2"], gravity_of("20"))
        assert (entry["payload_kg"], entry["payload_at_m"]) == (0.02, 0.0)
        assert entry["valid_fraction"] > 0.9
        assert 0.0 < entry["mean_error_m"] <= entry["max_error_m"] < 0.1
        assert entry["checks"]["tracker_rms_m"] < 1e-3
    # With feedback, a late revision is looked for among the commands to come, and may be like one.
    assert entries[0]["checks"]["board_lost"] == entries[0]["checks"]["board_out_of_order"] == 0
    feedback = entries[1]["extra"]["feedback"]
    assert feedback["latency_median_s"] > 0.0
    assert max(feedback["correction_rms_pa"]) > 10.0
    # The tracker saw a limb that sagged before the motion began, and the plan begins there.
    played = load_run(run.out / entries[0]["bag"])
    rest = np.nanmedian(played.tip.value[played.tip.time < 0.0], axis=0)
    assert rest[1] < -0.05
    assert np.linalg.norm(played.reference.value[0] - rest) < 0.03
    for name in ("tip.png", "error.png", "pressures.png", "report.html"):
        assert (run.out / "report" / name).stat().st_size > 5000
    assert_vented_and_closed(run, "same_direction_der_paper_trial1")


def test_a_rig_file_takes_the_place_of_the_twin_and_a_path_of_a_file_is_learned(
    experiment, graph, rig: Path, tmp_path: Path
):
    file = tmp_path / "arc.csv"
    # Near the limb at rest, from where and to where it moves as well.
    points = np.array([[0.23 - 0.0015 * k, 0.07 + 0.004 * k] for k in range(5)])
    rows = [f"{500 * i}, {100 * x:.2f}, {100 * y:.2f}" for i, (x, y) in enumerate(points)]
    file.write_text("\n".join(["time [ms], x [cm], y [cm]", *rows]))
    rig_and_path = ("--hardware", str(rig), "--path", str(file))
    run = experiment(*rig_and_path, "--models", "der", "--learn", "1", "--no-report")
    assert run.finish() == 0, run.errors
    first, second = json.loads((run.out / "results.json").read_text())["runs"]
    assert (first["motion"], first["model"]) == ("arc", "der")
    assert (first["method"], second["method"]) == ("paper", "learned 1")
    assert min(first["valid_fraction"], second["valid_fraction"]) > 0.9
    reference = load_run(run.out / first["bag"]).reference
    for point in points:
        assert np.linalg.norm(reference.value - point, axis=1).min() < 1e-3
    assert second["mean_error_m"] < 0.8 * first["mean_error_m"]
    assert "run 1: mean error" in run.errors
    (kept,) = (run.out / "learned").glob("*_run2.yaml")
    played = load_run(run.out / second["bag"]).setpoints.value
    np.testing.assert_allclose(played, read_plan(kept).differential_pressure, atol=1e-3)
    assert run.processes() == {}
    assert all(process.alive for process in graph.processes), "the rig is not the experiment's"


def assert_vented_and_closed(run: Experiment, name: str) -> None:
    assert run.processes() == {}
    bag = run.out / "bags" / name
    assert (bag / "metadata.yaml").exists()
    np.testing.assert_allclose(last_board_command(bag), 0.0, atol=1.0)
