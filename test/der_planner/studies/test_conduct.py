"""A study is played: on processes of this machine, on a cluster that breaks, and after a stop."""

import signal
from pathlib import Path

import pyarrow.parquet
import pytest

from der_planner.experiment.console import Progress
from der_planner.studies import conduct as conducting
from der_planner.studies.conduct import (
    Calibrated,
    Outcome,
    PlaySettings,
    Store,
    compute,
    conduct,
)
from der_planner.studies.factors import StudyError
from der_planner.studies.study import Study
from der_planner.studies.tasks import calibrated

from .cluster import Processes, free_port, wait_for

pytestmark = pytest.mark.slow

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
  period: [1, 1.5, 2]
  cycles: 1
  amplitude: [0.3, 1.9]
  method: projected
  error.moment_gain: {low: -0.1, high: 0.1}
draw: {method: random, count: 8}
keep: [mean_error_m, max_error_m]
plots:
  - {name: errors, kind: lines, x: period, y: mean_error_m, panels: amplitude}
"""


@pytest.fixture
def processes(tmp_path):
    running = Processes(tmp_path)
    yield running
    running.close()


def write(folder: Path, text: str, name: str = "small.yaml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def records(folder: Path) -> list[dict]:
    """Return every record of every file, so that what is there twice shows."""
    return [
        record
        for path in sorted((folder / "rows").glob("*.parquet"))
        for record in pyarrow.parquet.read_table(path).to_pylist()
    ]


def by_key(folder: Path) -> dict[str, dict]:
    found = records(folder)
    assert len({record["key"] for record in found}) == len(found), "a row is there twice"
    return {record["key"]: record for record in found}


def count(folder: Path) -> int:
    return len(list((folder / "rows").glob("*.parquet")))


def test_one_or_two_workers_and_rows_that_fail(tmp_path, monkeypatch):
    """The same rows to the last digit, failed ones counted, and done again if that is asked for."""
    monkeypatch.setenv("DER_LIMB_CACHE", str(tmp_path / "cache"))
    study = Study.read(write(tmp_path, RODS))
    folders = [tmp_path / "one", tmp_path / "two"]
    for workers, folder in enumerate(folders, start=1):
        conduct(study, PlaySettings(folder, workers=workers), Progress())
    one, two = map(by_key, folders)
    assert one == two
    assert set(one) == {row.key for row in study.rows}
    errors = [record for record in one.values() if record["error"]]
    # 1.9 rad of bend in a second is beyond the pressures; 0.3 rad is not.
    assert {record["amplitude"] for record in errors} == {1.9}
    assert all(record["error"].startswith("UnreachableError: ") for record in errors)
    assert all(record["mean_error_m"] > 0 for record in one.values() if not record["error"])
    good, bad = (
        next(row for row in study.rows if bool(one[row.key]["error"]) is failed)
        for failed in (False, True)
    )
    Store(folders[0], study).keep(good, Outcome({}, "lost", one[bad.key]["sources"]))
    settings = PlaySettings(folders[0], workers=1, retry_failed=True)
    assert conduct(study, settings, Progress()) == one


def test_a_cluster_that_breaks(tmp_path, processes):
    """A worker is killed, then the scheduler: nothing is lost, nothing comes twice."""
    path = write(tmp_path, TWINS.format(count=14))
    study, out = Study.read(path), tmp_path / "out"
    scheduler = processes.scheduler()
    doomed, other = processes.worker(), processes.worker()
    arguments = [str(path), "--scheduler", processes.address, "--out", str(out)]
    command = processes.study(*arguments)
    wait_for(lambda: count(out) >= 2, "two rows")
    doomed.send_signal(signal.SIGKILL)
    before = count(out)
    wait_for(lambda: count(out) >= before + 3, "rows of the other worker")
    scheduler.send_signal(signal.SIGKILL)
    assert command.wait(300) == 1, processes.said()
    assert "the scheduler is gone" in processes.said()
    assert "the same command goes on from here" in processes.said()
    kept = {name.name: name.stat().st_mtime_ns for name in (out / "rows").iterdir()}
    assert len(kept) < len(study.rows), "the study was over before its scheduler was killed"
    other.wait(300)
    processes.scheduler()
    processes.worker()
    assert processes.study(*arguments).wait(600) == 0, processes.said()
    assert set(by_key(out)) == {row.key for row in study.rows}
    after = {name.name: name.stat().st_mtime_ns for name in (out / "rows").iterdir()}
    assert {name: after[name] for name in kept} == kept, "a row that was there was done again"
    assert "14 of 14 rows are done, 0 of them failed" in processes.said()
    assert "<h1>Study small</h1>" in (out / "report" / "report.html").read_text()


def test_a_stopped_study_goes_on(tmp_path, processes):
    """SIGTERM ends it in order, SIGKILL does not; both go on, with the digits of a run at once."""
    path = write(tmp_path, TWINS.format(count=8))
    study, out = Study.read(path), tmp_path / "out"
    arguments = [str(path), "--out", str(out), "--workers", "1"]
    for number, code in ((signal.SIGTERM, 130), (signal.SIGKILL, -signal.SIGKILL)):
        before = count(out) if out.exists() else 0
        command = processes.study(*arguments)
        wait_for(lambda least=before + 2: out.exists() and count(out) >= least, "two rows")
        command.send_signal(number)
        assert command.wait(300) == code, processes.said()
    assert "stopped by SIGTERM; what was done is kept" in processes.said()
    # As a loss of power leaves it: a file without its content.
    some = sorted((out / "rows").iterdir())[0]
    some.write_bytes(some.read_bytes()[:100])
    assert processes.study(*arguments, "--limit", "6").wait(600) == 0, processes.said()
    stopped = by_key(out)
    assert {row.key for row in study.rows[:6]} <= set(stopped)
    for row in study.rows[:6:2]:
        outcome = compute("run", row.values, Calibrated())
        for column in study.keep:
            assert stopped[row.key][column] == outcome.results[column]


def test_a_twin_is_calibrated_once(tmp_path, monkeypatch):
    """Both workers need it at once; whoever asks later gets the same file."""
    monkeypatch.setenv("DER_LIMB_CACHE", str(tmp_path / "cache"))
    text = "task: run\nfactors: {seed: 5, period: 1, cycles: 1, amplitude: 0.1, model: [der, pcc]}"
    study, out = Study.read(write(tmp_path, text)), tmp_path / "out"
    conduct(study, PlaySettings(out, workers=2), Progress())
    kept = by_key(out)
    assert len(kept) == 2
    assert all(record["error"] is None for record in kept.values())
    # Below what a twin that was never calibrated leaves, by far.
    assert max(record["mean_error_m"] for record in kept.values()) < 0.01
    (limb,) = (tmp_path / "cache" / "twins").glob("*.yaml")
    written = limb.stat().st_mtime_ns
    assert calibrated(study.task.twin(study.rows[0].values), "") == limb.read_text()
    assert limb.stat().st_mtime_ns == written


def test_what_cannot_be_written_is_named(tmp_path):
    study = Study.read(write(tmp_path, RODS))
    (tmp_path / "file").write_text("")
    with pytest.raises(StudyError, match=f"cannot write into {tmp_path / 'file'}"):
        Store(tmp_path / "file", study)
    store = Store(tmp_path / "out", study)
    # A file name that is too long for the disk stands for a full one, which no test may make.
    (tmp_path / "out" / "rows").rmdir()
    (tmp_path / "out" / "rows").symlink_to("/dev/full")
    with pytest.raises(StudyError, match="Rows that are there are kept"):
        store.keep(study.rows[0], Outcome({"mean_error_m": 1.0}))


def test_no_scheduler(tmp_path, monkeypatch):
    monkeypatch.setattr(conducting, "PATIENCE", 0.5)
    address = f"tcp://127.0.0.1:{free_port()}"
    study = Study.read(write(tmp_path, RODS))
    with pytest.raises(StudyError, match=f"no Dask scheduler answers at {address}"):
        conduct(study, PlaySettings(tmp_path / "out", address), Progress())
