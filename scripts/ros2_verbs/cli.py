"""The command line: picks the command's module, and turns errors and signals into exit codes."""

from __future__ import annotations

import argparse
import importlib
import io
import os
import signal
import sys
from collections.abc import Callable, Sequence

COMMANDS = {
    "action": "Various action related sub-commands",
    "interface": "Show information about ROS interfaces",
    "node": "Various node related sub-commands",
    "param": "Various param related sub-commands",
    "run": "Run a package specific executable",
    "service": "Various service related sub-commands",
    "topic": "Various topic related sub-commands",
}

Main = Callable[[argparse.Namespace], "str | int | None"]
"""Does a verb's work. Returns an exit code, a sentence for stderr (exit code 1), or None for 0."""


class CommandError(RuntimeError):
    """The command cannot be done; the message is what the real tool says."""


class Terminated(BaseException):
    """The process was sent SIGTERM."""


class Interruption:
    """Ends a command by an exception where SIGINT or SIGTERM finds it.

    Python drops an exception that is raised inside a destructor or a callback of the garbage
    collector. So it is raised again, every `AGAIN` seconds, until the command has ended.
    """

    AGAIN = 0.5

    def __init__(self) -> None:
        self._error: type[BaseException] = KeyboardInterrupt
        signal.signal(signal.SIGALRM, self._raise)
        signal.signal(signal.SIGINT, self._end)
        signal.signal(signal.SIGTERM, self._end)

    def _end(self, number: int, _: object) -> None:
        self._error = Terminated if number == signal.SIGTERM else KeyboardInterrupt
        signal.setitimer(signal.ITIMER_REAL, self.AGAIN, self.AGAIN)
        raise self._error

    def _raise(self, *_: object) -> None:
        raise self._error

    @staticmethod
    def noticed() -> None:
        """Raise no more: the command is ending."""
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def add_verbs(parser: argparse.ArgumentParser, command: str) -> argparse._SubParsersAction:
    """Return the place where a command adds its verbs."""
    parser.set_defaults(help_of=parser)
    return parser.add_subparsers(
        title="Commands", metavar=f"Call `ros2 {command} <command> -h` for more detailed usage."
    )


def add_verb(
    verbs: argparse._SubParsersAction, name: str, description: str, main: Main
) -> argparse.ArgumentParser:
    """Add one verb to a command and return its parser."""
    parser: argparse.ArgumentParser = verbs.add_parser(
        name, help=description, description=description
    )
    parser.set_defaults(main=main)
    return parser


def _parser(arguments: Sequence[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ros2",
        description="ros2 is an extensible command-line tool for ROS 2.",
        epilog="This is the workspace's stand-in for ros2cli, which the PyPI wheels of ROS lack: "
        "it has only the commands above.",
    )
    parser.set_defaults(main=None, help_of=parser)
    commands = parser.add_subparsers(
        title="Commands", metavar="Call `ros2 <command> -h` for more detailed usage."
    )
    chosen = next((part for part in arguments if not part.startswith("-")), None)
    for name, description in COMMANDS.items():
        command = commands.add_parser(name, help=description, description=description)
        if name == chosen:
            # Only the chosen one is imported: `run` then needs no rclpy.
            importlib.import_module(f"ros2_verbs.{name}").add_arguments(command)
    return parser


def main(arguments: Sequence[str]) -> str | int | None:
    """Run a command line.

    Args:
        arguments: without the name of the program.

    Returns:
        What `sys.exit` takes: an exit code, or a sentence for stderr that means exit code 1.
    """
    options = _parser(arguments).parse_args(list(arguments))
    if options.main is None:
        options.help_of.print_help()
        return 0
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A reader at the other end of a pipe sees each message when it comes.
        sys.stdout.reconfigure(line_buffering=True)
    interruption = Interruption()
    try:
        result: str | int | None = options.main(options)
    except KeyboardInterrupt:
        result = int(signal.SIGINT)
    except BrokenPipeError:
        # The reader of a pipe has gone (`| head -1`). What is still buffered must go nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        result = 128 + signal.SIGPIPE
    except Terminated:
        result = int(signal.SIGTERM)
    except RuntimeError as error:
        result = str(error)
    interruption.noticed()
    return result
