"""The page of `run_experiment.py --page`, in the place of whose runs the test looks at it."""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.request import Request, urlopen

import pytest
from domain import own_domain
from waiting import wait_for
from websockets.sync.client import connect

from der_planner.commands import run_experiment
from der_planner.experiment.console import Progress
from der_planner.experiment.options import Options
from der_planner.experiment.processes import PAGE_TOKEN, GraphError
from limb_interfaces.entry import END_SIGNALS

pytestmark = pytest.mark.graph


class Visitor:
    """Looks at the page at a port as a browser does."""

    def __init__(self) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
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
    seen: list[str] = []

    def close_at_the_end() -> None:
        """See the report, which the page offers when the runs are over, and press Ctrl-C."""
        try:
            wait_for(lambda: visitor.look()[0].startswith("done; the page stays"), "the end")
            wait_for(lambda: visitor.look()[1], "the report to be offered")
            seen.append(visitor.get("/report/report.html"))
        except ConnectionError:
            return  # it has been closed already
        except Exception as error:
            seen.append(str(error))
        os.kill(os.getpid(), signal.SIGINT)

    reader = threading.Thread(target=close_at_the_end)

    def play(options: Options, progress: Progress) -> None:
        progress.say("calibrates")
        wait_for(lambda: visitor.look() == ("calibrates", False), "what the experiment does")
        (options.out / "report").mkdir(parents=True)
        (options.out / "report" / "report.html").write_text("all went well")
        reader.start()

    monkeypatch.setattr(run_experiment, "run", play)
    assert run_experiment.main() == 0
    reader.join()
    assert seen == ["all went well"]
    with pytest.raises(URLError):
        visitor.get("/")


def test_the_page_says_why_an_experiment_has_stopped_and_stays(
    visitor: Visitor, monkeypatch: pytest.MonkeyPatch
) -> None:
    why, seen = "the motion was not played to its end: the driver was told to vent", [False]

    def alarms() -> bool:
        texts = [alarm["text"] for alarm in visitor.data()["alarms"]]
        seen[0] = any(text.startswith(f"The experiment has stopped: {why}") for text in texts)
        return seen[0]

    def read_the_alarm() -> None:
        try:
            wait_for(alarms, "the alarm")
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    reader = threading.Thread(target=read_the_alarm)

    def play(options: Options, progress: Progress) -> None:
        reader.start()
        raise GraphError(why)

    monkeypatch.setattr(run_experiment, "run", play)
    assert run_experiment.main() == 1
    reader.join()
    assert seen[0]
