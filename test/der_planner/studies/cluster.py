"""A Dask cluster of separate processes, and the command of a study beside it."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_for(condition, what: str, timeout: float = 600.0):
    """Return what a condition returns as soon as it is true."""
    end = time.monotonic() + timeout
    while not (found := condition()):
        assert time.monotonic() < end, f"{what} did not come within {timeout} s"
        time.sleep(0.02)
    return found


class Processes:
    """Schedulers, workers and studies as processes that end with the test."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.port = free_port()
        self.address = f"tcp://127.0.0.1:{self.port}"
        self._all: list[subprocess.Popen[bytes]] = []

    def start(self, *command: str, log: str) -> subprocess.Popen[bytes]:
        with (self.folder / log).open("ab") as output:
            process = subprocess.Popen(
                command,
                stdout=output,
                stderr=output,
                start_new_session=True,
                env={**os.environ, "DER_LIMB_CACHE": str(self.folder / "cache")},
            )
        self._all.append(process)
        return process

    def scheduler(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "dask", "scheduler", "--host", "127.0.0.1"]
        process = self.start(
            *command, "--port", str(self.port), "--no-dashboard", log="scheduler.log"
        )
        wait_for(self._listens, "the scheduler")
        return process

    def _listens(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def worker(self) -> subprocess.Popen[bytes]:
        options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1"]
        command = [sys.executable, "-m", "dask", "worker", self.address]
        local = ["--local-directory", str(self.folder)]
        return self.start(*command, *options, *local, log="workers.log")

    def study(self, *arguments: str, log: str = "study.log") -> subprocess.Popen[bytes]:
        script = str(ROOT / "scripts" / "study.py")
        return self.start(sys.executable, script, *arguments, log=log)

    def said(self, log: str = "study.log") -> str:
        return (self.folder / log).read_text()

    def close(self) -> None:
        for process in reversed(self._all):
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
