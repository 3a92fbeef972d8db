"""The calibration through the running graph agrees with the one in a single process."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from domain import own_domain

ROOT = Path(__file__).resolve().parent.parent.parent
SEED = 3
pytestmark = pytest.mark.graph


def calibrate(out: Path, excitation: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    domain = str(own_domain(__file__))
    return subprocess.run(
        [
            sys.executable,
            ROOT / "scripts" / "calibrate_limb.py",
            *("--seed", str(SEED), "--play", excitation, "--terms", "none", "--out", out),
            *arguments,
        ],
        env={**os.environ, "ROS_DOMAIN_ID": domain},
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )


def short_run(folder: Path, duration: float = 18.0) -> tuple[Path, np.ndarray]:
    """Write slow waves between two rests; return the file and the pressures (K, 2) [Pa]."""
    from der_planner.identification import Excitation, write_excitation
    from der_planner.identification.excitation import PERIOD, waves

    rest = np.zeros((20, 2))
    pressure = np.concatenate([rest, waves(10_000.0, 2, duration), rest])
    path = folder / "excitation.csv"
    write_excitation(Excitation(PERIOD * np.arange(len(pressure)), pressure, ()), path)
    return path, pressure


def test_the_graph_calibrates_as_one_process_does(tmp_path: Path):
    from der_planner.bags.reader import BagReader
    from der_planner.identification import read_bag
    from der_planner.limb import Limb

    excitation, pressure = short_run(tmp_path)

    # A first guess far from the twin, so that only the data can bring both files together.
    guess = Limb.default()
    segments = tuple(replace(s, moment_gain=1.3 * s.moment_gain) for s in guess.segments)
    prior = tmp_path / "prior.yaml"
    replace(guess, segments=segments).to_yaml(prior)

    graph_file, offline_file = tmp_path / "graph.yaml", tmp_path / "offline.yaml"
    given = ("--prior", str(prior))
    run = calibrate(graph_file, excitation, "--graph", "--folder", str(tmp_path / "run"), *given)
    assert run.returncode == 0, run.stderr
    assert "WARNING" not in run.stderr
    offline = calibrate(offline_file, excitation, "--offline", *given)
    assert offline.returncode == 0, offline.stderr

    bag = tmp_path / "run" / "bag"
    with BagReader(bag) as reader:
        sent = [m for _, _, m in reader.messages(["/limb/pressure_setpoint"])]
    (plan_id,) = {message.plan_id for message in sent}
    assert plan_id.startswith("calibration-")
    assert [message.index for message in sent] == list(range(len(pressure)))
    assert all(message.header.stamp.nanosec % 50_000_000 == 0 for message in sent)
    np.testing.assert_allclose([m.differential_pressure for m in sent], pressure, atol=1e-4)
    log = read_bag(bag)
    np.testing.assert_allclose(log.commanded_differential[-1], 0.0, atol=1.0)
    assert (tmp_path / "run" / "report" / "report.txt").stat().st_size > 100

    gains = [
        np.array([segment.moment_gain for segment in Limb.from_yaml(path).segments])
        for path in (graph_file, offline_file)
    ]
    wrong = np.array([segment.moment_gain for segment in segments])
    assert np.all(np.abs(gains[1] / wrong - 1.0) > 0.15)
    np.testing.assert_allclose(gains[0], gains[1], rtol=0.08)


def test_a_rig_is_calibrated_and_left_vented(graph, rig: Path, tmp_path: Path):
    from der_planner.identification import read_bag
    from der_planner.limb import Limb

    excitation, pressure = short_run(tmp_path, duration=10.0)
    out, folder = tmp_path / "rig_limb.yaml", tmp_path / "run"
    run = calibrate(out, excitation, "--graph", "--hardware", str(rig), "--folder", str(folder))
    assert run.returncode == 0, run.stderr
    assert "the hardware at" in run.stderr
    assert all(process.alive for process in graph.processes), "the rig is not the calibration's"
    log = read_bag(folder / "bag")
    assert np.abs(log.measured_differential[-1]).max() < 0.1 * np.abs(pressure).max()
    found, prior = Limb.from_yaml(out), Limb.default()
    assert found.provenance["prior"] == prior.name
    assert np.all(np.abs(found.static_gain / prior.static_gain - 1.0) < 0.5)


def test_a_table_that_cannot_be_played_starts_nothing(tmp_path: Path):
    excitation = tmp_path / "excitation.csv"
    excitation.write_text("time_s,a,b\n0,0,0\n0.05,0,30000\n")
    run = calibrate(tmp_path / "x.yaml", excitation, "--graph", "--folder", str(tmp_path / "run"))
    assert run.returncode == 1
    assert "asks for 30000 Pa, the limit is ±24000 Pa" in run.stderr
    assert not (tmp_path / "run").exists()
