"""``ros2 run``: become an executable of a package."""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
from pathlib import Path

from ros2_verbs.cli import CommandError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``ros2 run``."""
    parser.set_defaults(main=_run)
    parser.add_argument(
        "--prefix",
        help="Prefix command, which should go before the executable (e.g. --prefix 'gdb -ex run "
        "--args')",
    )
    parser.add_argument("package_name", help="Name of the ROS package")
    parser.add_argument("executable_name", help="Name of the executable")
    parser.add_argument(
        "argv", nargs=argparse.REMAINDER, help="Pass arbitrary arguments to the executable"
    )


def package_prefix(package: str) -> Path:
    """Return the first prefix of AMENT_PREFIX_PATH in which the package is installed.

    Raises:
        CommandError: there is none.
    """
    for part in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        prefix = Path(part)
        if part and (prefix / "share/ament_index/resource_index/packages" / package).is_file():
            return prefix
    raise CommandError(f"Package '{package}' not found")


def find_executables(package: str, name: str) -> list[Path]:
    """Return the files of that name in the package's folder of executables, without hidden ones.

    Raises:
        CommandError: there is no such package.
    """
    folder = package_prefix(package) / "lib" / package
    return sorted(
        path
        for path in folder.rglob(name)
        if path.is_file()
        and os.access(path, os.X_OK)
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )


def _run(options: argparse.Namespace) -> str | None:
    if not options.executable_name or set(options.executable_name) & set("*?[/"):
        return "No executable found"
    found = find_executables(options.package_name, options.executable_name)
    if not found:
        return "No executable found"
    if len(found) > 1:
        return "Multiple executables found:" + "".join(f"\n- {path}" for path in found)
    command = [*shlex.split(options.prefix or ""), str(found[0]), *options.argv]
    program = shutil.which(command[0])
    if program is None:
        return f"No command '{command[0]}' to go before the executable"
    # The process becomes the executable: a signal to it reaches the node, whoever sends it.
    return os.execv(program, command)
