"""Nodes as child processes: started, watched, stopped, and never left behind."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from der_planner.experiment.errors import NodeError

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)


def find_executable(package: str, executable: str) -> Path:
    """Return the file that ``ros2 run PACKAGE EXECUTABLE`` would start.

    Raises:
        NodeError: no prefix of AMENT_PREFIX_PATH has it.
    """
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        candidate = Path(prefix) / "lib" / package / executable
        if prefix and os.access(candidate, os.X_OK):
            return candidate
    raise NodeError(
        f"no executable '{executable}' in package '{package}': build the workspace with "
        "python3 scripts/workspace.py setup"
    )


def _die_with_parent() -> None:
    # An orchestrator that is killed must not leave a limb under pressure: the nodes then get the
    # signal on which the driver vents.
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class NodeProcess:
    """One node in its own process group, its output in a log file.

    Args:
        package, executable: as for ``ros2 run``.
        parameters: values by name; written to a parameter file beside the log.
        remap: new names of topics by their old ones.
        folder: where the log and the parameter file go.
        environment: of the process; the caller's if None.
        name: of the log file; the executable's if empty.
    """

    def __init__(
        self,
        package: str,
        executable: str,
        parameters: Mapping[str, Any],
        folder: Path,
        remap: Mapping[str, str] | None = None,
        environment: Mapping[str, str] | None = None,
        name: str = "",
    ) -> None:
        self.name = name or executable
        self.executable = executable
        self.log = folder / f"{self.name}.log"
        self.cpu_seconds = 0.0
        """User and system time that the process had used when it was last looked at [s]."""
        self._started = time.monotonic()
        folder.mkdir(parents=True, exist_ok=True)
        parameter_file = folder / f"{self.name}.yaml"
        parameter_file.write_text(
            yaml.safe_dump({"/**": {"ros__parameters": dict(parameters)}}, sort_keys=True)
        )
        command = [str(find_executable(package, executable)), "--ros-args"]
        if parameters:
            command += ["--params-file", str(parameter_file)]
        for old, new in (remap or {}).items():
            command += ["-r", f"{old}:={new}"]
        with self.log.open("wb") as output:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=_die_with_parent,  # noqa: PLW1509 - it allocates nothing
                env=None if environment is None else dict(environment),
            )

    @property
    def pid(self) -> int:
        """Process id, also of the process group."""
        return self._process.pid

    @property
    def exit_code(self) -> int | None:
        """Exit code, or None while the process runs."""
        return self._process.poll()

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self.exit_code is None

    def measure_cpu(self) -> float:
        """Return the CPU time used so far [s] and the last known one after the end."""
        with contextlib.suppress(OSError, ValueError, IndexError):
            fields = Path(f"/proc/{self.pid}/stat").read_text().rsplit(")", 1)[1].split()
            self.cpu_seconds = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        return self.cpu_seconds

    def last_words(self, lines: int = 6) -> str:
        """Return the end of the log, preferring what the node called an error."""
        text = self.log.read_text(errors="replace").splitlines()
        complaints = [line for line in text if line.startswith("error:")]
        return "\n".join(complaints[-lines:] or text[-lines:])

    def check(self) -> None:
        """Raise if the process has ended.

        Raises:
            NodeError: with the exit code, the last words and the log's path.
        """
        if not self.alive:
            raise NodeError(
                f"node '{self.name}' died ({_describe(self.exit_code)}). Its last words:\n"
                f"{self.last_words()}\nThe whole log: {self.log}"
            )

    def signal(self, number: int) -> None:
        """Send a signal to the process group if it still runs."""
        if self.alive:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, number)

    def stop(self, timeout: float = 20.0) -> int:
        """End it with SIGTERM, after ``timeout`` seconds with SIGKILL; return the exit code."""
        self.measure_cpu()
        self.signal(signal.SIGTERM)
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            self.signal(signal.SIGKILL)
            self._process.wait()
        return int(self._process.returncode)


def _describe(code: int | None) -> str:
    if code is not None and code < 0:
        return f"killed by {signal.Signals(-code).name}"
    return f"exit code {code}"
