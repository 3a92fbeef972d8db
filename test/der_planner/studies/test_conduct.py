"""A study is played: on processes of this machine, on a cluster that breaks, and after a stop."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from distributed import LocalCluster

from der_planner.experiment.console import Progress
from der_planner.studies import conduct as conducting
from der_planner.studies.conduct import Outcome, PlaySettings, Store, compute, conduct
from der_planner.studies.factors import StudyError
from der_planner.studies.report import summarise
from der_planner.studies.study import Study
from der_planner.studies.tasks import Twin, calibrated

pytestmark = pytest.mark.slow
SCRIPT = Path(__file__).resolve().parents[3] / "scripts" / "study.py"

# A twin that is planned for without calibration, in motions of a second: a whole run, and short.
TWINS = """
task: run
factors:
  seed: {{first: 1, count: {count}}}
  calibration: none
  motion: same_direction
  period: 1
  cycles: 1
  amplitude: 0.05
  method: projected
keep: [mean_error_m, max_error_m]
"""
# The rod alone: a plan, and simulations of it.
RODS = """
task: model
factors:
  motion: same_direction
  period: [1, 2]
  cycles: 1
  amplitude: [0.3, 1.9]
  method: projected
  error.moment_gain: {low: -0.1, high: 0.1}
draw: {method: random, count: 2}
keep: [mean_error_m, max_error_m]
plots:
  - {name: errors, kind: lines, x: period, y: mean_error_m, panels: amplitude}
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "small.yaml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """Return the address of a cluster with two workers that runs already."""
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as running:
        yield running.scheduler_address


def test_rows_that_fail_are_kept_and_done_again_if_that_is_asked_for(tmp_path, cluster):
    """To the same last digit."""
    study = Study.read(write(tmp_path, RODS))
    settings = PlaySettings(tmp_path / "out", cluster, retry_failed=True)
    found = conduct(study, settings, Progress())
    assert set(found) == {row.key for row in study.rows}
    errors = [record for record in found.values() if record["error"]]
    # 1.9 rad of bend in a second is beyond the pressures; 0.3 rad is not.
    assert {record["amplitude"] for record in errors} == {1.9}
    assert all(record["error"].startswith("UnreachableError: ") for record in errors)
    assert all(record["mean_error_m"] > 0 for record in found.values() if not record["error"])
    good = next(row for row in study.rows if not found[row.key]["error"])
    store = Store(settings.out, study)
    store.keep(good, Outcome({}, "lost", errors[0]["sources"]))
    assert conduct(study, settings, Progress()) == found
    page = summarise(study, found, store)
    assert {"errors.png", "errors.pdf"} <= {path.name for path in page.parent.iterdir()}


class Breaking(Progress):
    """Ends a worker process when two rows are there, and the whole cluster when four are."""

    def __init__(self, cluster: LocalCluster) -> None:
        super().__init__()
        self._cluster, self._doomed = cluster, cluster.workers[0].pid

    def bar(self, done: float, total: float, text: str, unit: str = "s") -> None:
        if done >= 2 and self._doomed:
            os.kill(self._doomed, signal.SIGKILL)
            self._doomed = 0
        if done >= 4:
            self._cluster.close()


def test_a_cluster_that_breaks(tmp_path, cluster):
    """A worker is killed, then the scheduler is gone: nothing is lost, nothing is done again."""
    study, out = Study.read(write(tmp_path, TWINS.format(count=6))), tmp_path / "out"
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as doomed:
        settings = PlaySettings(out, doomed.scheduler_address)
        with pytest.raises(StudyError, match=r"scheduler is gone.*same command goes on from here"):
            conduct(study, settings, Breaking(doomed))
    kept = (out / "rows.jsonl").read_text()
    assert 4 <= len(Store(out, study).load()) < len(study.rows)
    found = conduct(study, PlaySettings(out, cluster), Progress())
    assert list(found) == [row.key for row in study.rows]
    assert {record["error"] for record in found.values()} == {None}
    text = (out / "rows.jsonl").read_text()
    assert text.startswith(kept)
    assert text.count("{") == len(study.rows)


def test_a_stopped_study_goes_on(tmp_path, cluster):
    """With the digits of a run at once; and SIGTERM ends it in order."""
    path = write(tmp_path, TWINS.format(count=6))
    study, out = Study.read(path), tmp_path / "out"
    command = [sys.executable, str(SCRIPT), str(path), "--out", str(out)]
    with subprocess.Popen(
        [*command, "--workers", "1"], stderr=subprocess.PIPE, text=True
    ) as running:
        while len(Store(out, study).load()) < 2:
            assert running.poll() is None, running.communicate()
            time.sleep(0.02)
        running.send_signal(signal.SIGTERM)
        _, said = running.communicate(timeout=300)
    assert running.returncode == 130, said
    assert "stopped by SIGTERM; what was done is kept" in said
    # As a kill or a loss of power leaves it: a line without its end.
    rows = out / "rows.jsonl"
    rows.write_bytes(rows.read_bytes()[:-30])
    more = ["--scheduler", cluster, "--limit", "5"]
    subprocess.run([*command, *more], check=True, timeout=600)
    stopped = Store(out, study).load()
    assert {row.key for row in study.rows[:5]} <= set(stopped)
    # The first row came from a process of this machine, the last one from the cluster.
    for row in (study.rows[0], study.rows[4]):
        outcome = compute("run", row.values, "")
        for column in study.keep:
            assert stopped[row.key][column] == outcome.results[column]
    assert "<h1>Study small</h1>" in (out / "report" / "report.html").read_text()


def test_a_twin_is_calibrated_once(tmp_path, monkeypatch):
    """Two threads need it at once; whoever asks later gets the same file."""
    monkeypatch.setenv("DER_LIMB_CACHE", str(tmp_path / "cache"))
    fitted = []
    monkeypatch.setattr(Twin, "fit", lambda twin, prior: (fitted.append(twin) or prior, None))
    with ThreadPoolExecutor() as threads:
        found = set(threads.map(lambda seed: calibrated(Twin(seed), ""), [6, 6]))
    assert {calibrated(Twin(6), "")} == found
    assert fitted == [Twin(6)]


def test_what_cannot_be_written_or_reached_is_named(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    study = Study.read(write(tmp_path, RODS))
    with pytest.raises(StudyError, match=f"cannot write into {tmp_path / 'file'}: .* kept"):
        Store(tmp_path / "file", study)
    monkeypatch.setattr(conducting, "PATIENCE", 0.5)
    with pytest.raises(StudyError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:1"):
        conduct(study, PlaySettings(tmp_path / "out", "tcp://127.0.0.1:1"), Progress())
