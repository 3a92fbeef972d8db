"""The page of `run_experiment.py --page`, in the place of whose runs the test looks at it."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import Mock
from urllib.error import URLError
from urllib.request import Request, urlopen

import pytest
from domain import free_port, own_domain
from waiting import wait_for
from websockets.sync.client import connect

from der_planner.commands import run_experiment
from der_planner.experiment import graph_run
from der_planner.experiment.console import Progress
from der_planner.experiment.options import Options
from der_planner.experiment.processes import PAGE_TOKEN, GraphError
from limb_interfaces.entry import END_SIGNALS

pytestmark = pytest.mark.graph


class Visitor:
    """Looks at the page at a port as a browser does."""

    def __init__(self) -> None:
        self.port = free_port()
        self._headers = {"Cookie": f"limb_token_{self.port}={PAGE_TOKEN}"}

    def get(self, path: str) -> str:
        request = Request(f"http://127.0.0.1:{self.port}{path}", headers=self._headers)
        with urlopen(request, timeout=10.0) as answer:
            return str(answer.read().decode())

    def look(self) -> tuple[str, bool]:
        """Return what the experiment says of itself, and whether the page has its report."""
        data = self.data()
        said = [node["message"] for node in data["nodes"] if node["own"] == "experiment"]
        return "".join(said), data["report"]

    def data(self) -> dict[str, Any]:
        """Return what the page is sent."""
        address, origin = f"ws://127.0.0.1:{self.port}/live", f"http://127.0.0.1:{self.port}"
        with connect(address, origin=origin, additional_headers=self._headers) as live:  # type: ignore[arg-type]
            live.send("0 window tab")
            data: dict[str, Any] = json.loads(live.recv(timeout=10.0))
        return data


@pytest.fixture
def visitor(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Visitor]:
    """Prepare the command line of an experiment with a page, and give the signals back."""
    visitor = Visitor()
    before = {each: signal.getsignal(each) for each in END_SIGNALS}
    monkeypatch.setenv("ROS_DOMAIN_ID", str(own_domain(__file__)))
    given = ["--page", str(visitor.port), "--out", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", ["run_experiment.py", *given])
    yield visitor
    for each, handler in before.items():
        signal.signal(each, handler)


def test_the_page_is_there_before_the_first_run_and_after_the_last(
    visitor: Visitor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here the last one fails, which the page says in an alarm."""
    why, seen = "the motion was not played to its end: the driver was told to vent", []

    def alarmed() -> bool:
        texts = [alarm["text"] for alarm in visitor.data()["alarms"]]
        return any(text.startswith(f"The experiment has stopped: {why}") for text in texts)

    def close_at_the_end() -> None:
        """See alarm and report, which the page offers when the runs are over, and press Ctrl-C."""
        try:
            wait_for(alarmed, "the alarm")
            wait_for(lambda: visitor.look()[1], "the report to be offered")
            seen.append(visitor.get("/report/report.html"))
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    reader = threading.Thread(target=close_at_the_end)

    def play(options: Options, progress: Progress) -> None:
        progress.say("calibrates")
        wait_for(lambda: visitor.look() == ("calibrates", False), "what the experiment does")
        (options.out / "report").mkdir(parents=True, exist_ok=True)
        (options.out / "report" / "report.html").write_text("what there is of it")
        reader.start()
        raise GraphError(why)

    monkeypatch.setattr(run_experiment, "run", play)
    assert run_experiment.main() == 1
    reader.join()
    assert seen == ["what there is of it"]
    with pytest.raises(URLError):
        visitor.get("/")


def test_a_page_that_has_ended_is_not_waited_for(
    visitor: Visitor, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = Mock(alive=False)
    page.failure.return_value = "node 'page' died"
    monkeypatch.setattr(graph_run, "experiment_page", lambda *_: nullcontext(page))
    monkeypatch.setattr(run_experiment, "run", lambda *_: None)
    assert run_experiment.main() == 0
    said = capsys.readouterr().err
    assert "done; the page stays with the report until Ctrl-C" in said
    assert "warning: node 'page' died" in said
