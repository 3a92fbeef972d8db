"""The calibration of a rig through the running graph agrees with its twin's in one process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from domain import own_domain
from limbs import with_segments

from der_planner.bags.reader import BagReader
from der_planner.commands import calibrate_limb
from der_planner.identification import read_bag
from der_planner.identification.excitation import Excitation, waves, write_excitation
from der_planner.limb import Limb

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "calibrate_limb.py"
RIG_SEED = "3"
"""Seed of the twin that stands in for the rig, see conftest.py."""
pytestmark = pytest.mark.graph


def test_a_rig_is_calibrated_as_its_twin_is_in_one_process(
    graph, rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    rest = np.zeros((20, 2))
    pressure = np.concatenate([rest, waves(12_000.0, 2, 12.0), rest])
    table = tmp_path / "excitation.csv"
    write_excitation(Excitation(pressure), table)
    # A first guess far from the twin, so that only the data can bring both files together.
    guess = Limb.default()
    wrong = with_segments(guess, moment_gain=lambda s: 1.6 * s.moment_gain)
    prior = tmp_path / "prior.yaml"
    wrong.to_yaml(prior)

    folder, given = tmp_path / "run", ("--terms", "none", "--play", table, "--prior", prior)
    graph_file, offline_file = tmp_path / "graph.yaml", tmp_path / "offline.yaml"
    onto = ("--graph", "--hardware", rig, "--folder", folder)
    run = subprocess.run(
        [sys.executable, SCRIPT, "--out", graph_file, *given, *onto],
        env={**os.environ, "ROS_DOMAIN_ID": str(own_domain(__file__))},
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert "the hardware at" in run.stderr
    assert "WARNING" not in run.stderr
    assert all(process.alive for process in graph.processes), "the rig is not the calibration's"
    offline = ("calibrate_limb.py", "--out", offline_file, *given, "--offline", "--seed", RIG_SEED)
    monkeypatch.setattr(sys, "argv", [*map(str, offline)])
    assert calibrate_limb.main() == 0

    with BagReader(folder / "bag") as reader:
        sent = [m for _, _, m in reader.messages(["/limb/pressure_setpoint"])]
    (plan_id,) = {message.plan_id for message in sent}
    assert plan_id.startswith("calibration-")
    assert [message.index for message in sent] == list(range(len(pressure)))
    assert all(message.header.stamp.nanosec % 50_000_000 == 0 for message in sent)
    np.testing.assert_allclose([m.differential_pressure for m in sent], pressure, atol=1e-4)
    log = read_bag(folder / "bag")
    assert np.abs(log.measured_differential[-1]).max() < 0.1 * np.abs(pressure).max()
    assert (folder / "report" / "report.txt").stat().st_size > 100

    found = [Limb.from_yaml(path) for path in (graph_file, offline_file)]
    assert found[0].provenance["prior"] == guess.name
    gains, offline, given = (
        np.array([s.moment_gain for s in limb.segments]) for limb in (*found, wrong)
    )
    assert np.all(np.abs(offline / given - 1.0) > 0.3)
    np.testing.assert_allclose(gains, offline, rtol=0.15)  # a short run tells 9 %
