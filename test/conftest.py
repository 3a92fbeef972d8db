"""Fixtures for tests that start nodes: an own ROS domain, processes that never outlive the test."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared"
sys.path.insert(0, str(ROOT / "scripts"))
sys.path.insert(0, str(ROOT / "test" / "support"))
# A run under `nohup` would hand its ignored SIGHUP to every process that a test starts.
signal.signal(signal.SIGHUP, signal.SIG_DFL)


WHOLE_GRAPH = ("test_calibration", "test_experiment", "test_page_drawing", "test_two_computers")
"""Files of test/graph that run the whole graph, where each node is timed by the others."""
LONGEST = "test/documentation/test_site.py"
"""The file without nodes that takes longest."""


def _is_whole_graph(nodeid: str) -> bool:
    return nodeid.startswith(tuple(f"test/graph/{name}.py" for name in WHOLE_GRAPH))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the longest first: in parallel, none of them is then waited for at the end.

    The whole graph, which one worker runs alone, takes longer than any other file.
    """
    slow = {item.path for item in items if item.get_closest_marker("slow")}

    def late(item: pytest.Item) -> tuple[bool, bool]:
        longest = _is_whole_graph(item.nodeid) or item.nodeid.startswith(LONGEST)
        return not longest, item.path not in slow

    items.sort(key=late)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give each file to one worker, and all tests of the whole graph to the same one.

    pytest-xdist's own groups do nothing under pytest 9.2 (its issue 1386).
    """
    from xdist.scheduler import LoadFileScheduling

    class OneGraphAtATime(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return "graph" if _is_whole_graph(nodeid) else super()._split_scope(nodeid)

    return OneGraphAtATime(config, log) if config.getvalue("dist") == "loadfile" else None


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of data outside the project, or skip the test."""
    folder = SHARED / "data"
    if not folder.is_dir():
        pytest.skip(f"needs {folder}, which is not part of the project")
    return folder


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Return what calls a command and returns its exit code, and what it said on both outputs."""

    def called(command: Any, *arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", [command.__name__, *map(str, arguments)])
        try:
            code = command.main()
        except SystemExit as ended:
            code = ended.code
        return code, *capsys.readouterr()

    return called


class Graph:
    """Starts nodes in the domain of a test file and talks to them.

    ``client`` is the orchestrator's own `GraphClient`: wait_for, wait_ready, subscribe, call.
    """

    def __init__(self, folder: Path, file: Path) -> None:
        from domain import own_domain

        from der_planner.experiment.client import GraphClient

        self.domain_id = own_domain(file)
        self.folder = folder
        self.client = GraphClient("test", domain_id=self.domain_id)
        self.processes = []

    def start(self, package: str, executable: str, name: str = "", remap=None, **parameters):
        """Start a node as ``ros2 run`` would; returns its `NodeProcess`."""
        from der_planner.experiment.processes import NodeProcess

        environment = {**os.environ, "ROS_DOMAIN_ID": str(self.domain_id)}
        process = NodeProcess(
            package, executable, parameters, self.folder, remap, environment, name
        )
        self.processes.append(process)
        return process

    def close(self) -> None:
        """End all nodes at once, but boards after their drivers, which vent them."""
        boards = [each for each in self.processes if each.executable == "board_emulator"]
        others = [each for each in self.processes if each not in boards]
        for process in others:
            process.signal(signal.SIGTERM)
        for process in others + boards:
            process.stop()
        self.client.close()


@pytest.fixture
def graph(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Graph]:
    """Return a `Graph` whose processes end with the test."""
    running = Graph(tmp_path, request.path)
    yield running
    running.close()


@pytest.fixture(scope="module")
def module_graph(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Graph]:
    """Return a `Graph` whose processes end with the file, for tests that can share them."""
    running = Graph(tmp_path_factory.mktemp("graph"), request.path)
    yield running
    running.close()
