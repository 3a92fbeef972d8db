"""Earlier experiments: what is listed, what is shown, and that no other file leaves the machine."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from der_planner.page.afterwards.experiments import Experiments

RUN = {"motion": "circle", "model": "der", "method": "optimal", "trial": 1,
       "mean_error_m": 0.00123, "max_error_m": 0.004, "valid_fraction": 0.98}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    earlier = tmp_path / "experiments"
    for name in ("first", "second"):
        (earlier / name / "report").mkdir(parents=True)
        (earlier / name / "results.json").write_text(json.dumps({"runs": [RUN], "summary": []}))
    (earlier / "second" / "report" / "report.html").write_text("<p>report</p>")
    (earlier / "second" / "tip.png").write_bytes(b"png")
    (earlier / "second" / "bag.mcap").write_bytes(b"bag")
    (earlier / "not_one").mkdir()
    (tmp_path / "secret.html").write_text("secret")
    (earlier / "second" / "link.html").symlink_to(tmp_path / "secret.html")
    return earlier


def test_experiments_are_listed_with_their_numbers(folder: Path) -> None:
    experiments = Experiments(folder)
    assert sorted(experiments.names()) == ["first", "second"]
    found = experiments.load("second")
    assert found.rows == (("circle", "der", "optimal", "1", "0.123", "0.40", "98"),)
    assert (found.figures, found.report) == (("tip.png",), "report/report.html")
    assert experiments.load("first").report == ""


@pytest.mark.parametrize("text", ["", "[]", "{", '{"runs": [{}]}', '{"runs": 3}', '{"runs": [3]}'])
def test_broken_results_are_said_to_be_broken(folder: Path, text: str) -> None:
    (folder / "first" / "results.json").write_text(text)
    assert "cannot be read" in Experiments(folder).load("first").problem


def test_only_the_experiments_own_pictures_and_pages_are_handed_out(folder: Path) -> None:
    experiments = Experiments(folder)
    assert experiments.file("second", "tip.png") is not None
    assert experiments.file("second", "report/report.html") is not None
    for name, inside in (
        ("second", "../../secret.html"), ("second", "/etc/passwd"), ("second", "bag.mcap"),
        ("second", "link.html"), ("..", "secret.html"), ("second", ""), ("not_one", "x.html"),
        ("second", "tip.png\x00"),
    ):  # fmt: skip
        assert experiments.file(name, inside) is None


def test_no_folder_is_no_experiment(tmp_path: Path) -> None:
    assert Experiments(tmp_path / "none").names() == []
