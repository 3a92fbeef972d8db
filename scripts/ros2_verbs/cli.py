"""The command line: a table of verbs, and what turns errors and signals into exit codes."""

from __future__ import annotations

import argparse
import importlib
import io
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any


class CommandError(RuntimeError):
    """The command cannot be done; the message is what the real tool says."""


class EndedBySignal(BaseException):
    """SIGINT or SIGTERM has come; the argument is its number."""


def _positive(text: str) -> float:
    value = float(text)
    if not value > 0.0:
        raise argparse.ArgumentTypeError("value must be positive")
    return value


FLAG = {"action": "store_true"}
ARGUMENTS: dict[str, dict[str, Any]] = {
    "argv": {"nargs": argparse.REMAINDER, "help": "arguments of the executable"},
    "topic_name": {"help": "e.g. /chatter"},
    "message_type": {"help": "e.g. std_msgs/msg/String"},
    "type_of_messages": {"nargs": "?", "help": "e.g. std_msgs/msg/String; found out if left out"},
    "values": {
        "nargs": "?",
        "default": "{}",
        "help": "in YAML; 'header: auto' and 'stamp: now' become the time of sending",
    },
    "goal": {"help": "in YAML"},
    "node_or_all": {"nargs": "?", "help": "full name of a node"},
    "parameter_names": {"nargs": "+"},
    "--spin-time": {"type": float, "help": "seconds of discovery (default: until it is quiet)"},
    "--show-types": {**FLAG, "short": "-t", "help": "with types"},
    "--all": {**FLAG, "short": "-a", "help": "hidden ones, too"},
    "--field": {"help": "only this field, as pose.position"},
    "--once": {**FLAG, "short": "-1", "help": "only one message"},
    "--full-length": {**FLAG, "short": "-f", "help": "arrays and strings beyond 128 elements"},
    "--no-arr": {**FLAG, "help": "the length of arrays in place of their elements"},
    "--window": {"short": "-w", "type": _positive, "default": 10000.0, "help": "messages"},
    "--rate": {"short": "-r", "type": _positive, "default": 1.0, "help": "Hz"},
    "--times": {"short": "-t", "type": int, "default": 0, "help": "so many messages"},
    "--wait-matching-subscriptions": {
        "short": "-w",
        "type": int,
        "help": "wait for so many subscriptions (default: 1 with -1 and -t, else 0)",
    },
    "--feedback": {**FLAG, "short": "-f", "help": "print the feedback"},
    "--qos-profile": {"choices": ("default", "sensor_data", "services_default", "parameters")},
    "--qos-depth": {"type": int, "help": "length of the queue"},
    "--qos-reliability": {"choices": ("reliable", "best_effort")},
    "--qos-durability": {"choices": ("volatile", "transient_local")},
}
"""Arguments with settings for argparse, and ``short`` for a short name."""

QOS = "--qos-profile --qos-depth --qos-reliability --qos-durability"
VERBS = {
    "run": ("Run an executable of a package", "package_name executable_name argv"),
    "topic list": ("List the topics", "--spin-time --show-types --all"),
    "topic echo": (
        "Print the messages of a topic",
        f"topic_name type_of_messages --spin-time --field --once --full-length --no-arr {QOS}",
    ),
    "topic hz": ("Print how often messages arrive", "topic_name --spin-time --window"),
    "topic pub": (
        "Publish messages",
        f"topic_name message_type values --rate --once --times --wait-matching-subscriptions {QOS}",
    ),
    "service call": ("Call a service", "service_name service_type values"),
    "action send_goal": (
        "Send a goal to an action; Ctrl-C cancels it",
        "action_name action_type goal --feedback",
    ),
    "param list": ("List the parameters of one node or all", "node_or_all --spin-time"),
    "param get": ("Print a parameter", "node_name parameter_name --spin-time"),
    "param set": ("Set a parameter", "node_name parameter_name value --spin-time"),
    "param describe": (
        "Print type, meaning and range of parameters",
        "node_name parameter_names --spin-time",
    ),
}
"""Help and arguments of each verb; its function in `ros2_verbs.verbs` has its name."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ros2",
        description="The workspace's stand-in for ros2cli, which the PyPI wheels of ROS lack.",
    )
    parser.set_defaults(verb=None, help_of=parser)
    commands = parser.add_subparsers(title="Commands", metavar="COMMAND")
    groups: dict[str, Any] = {}
    for verb, (summary, arguments) in VERBS.items():
        command, _, word = verb.partition(" ")
        if word and command not in groups:
            words = [each.split()[1] for each in VERBS if each.startswith(f"{command} ")]
            group = commands.add_parser(command, help=", ".join(words))
            group.set_defaults(help_of=group)
            groups[command] = group.add_subparsers(title="Commands", metavar="COMMAND")
        place = groups.get(command, commands)
        added = place.add_parser(word or command, help=summary, description=summary)
        for name in arguments.split():
            settings = dict(ARGUMENTS.get(name, {}))
            names = [settings.pop("short"), name] if "short" in settings else [name]
            added.add_argument(*names, **settings)
        added.set_defaults(verb=verb.replace(" ", "_"))
    return parser


def _run(package: str, name: str, arguments: list[str]) -> str:
    """Become an executable of a package: a signal to this process then reaches the node."""
    for prefix in map(Path, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        if (prefix / "share/ament_index/resource_index/packages" / package).is_file():
            executable = prefix / "lib" / package / name
            if executable.is_file() and os.access(executable, os.X_OK):
                os.execv(executable, [str(executable), *arguments])
            return "No executable found"
    return f"Package '{package}' not found"


def main(arguments: Sequence[str]) -> str | int | None:
    """Run a command line.

    Args:
        arguments: without the name of the program.

    Returns:
        What `sys.exit` takes: an exit code, or a sentence for stderr that means exit code 1.
    """
    options = _parser().parse_args(list(arguments))
    if options.verb is None:
        options.help_of.print_help()
        return 0
    if options.verb == "run":
        return _run(options.package_name, options.executable_name, options.argv)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A reader at the other end of a pipe sees each message when it comes.
        sys.stdout.reconfigure(line_buffering=True)
    # The command ends where it next looks at them.
    options.signals = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: options.signals.append(number))
    try:
        verbs = importlib.import_module("ros2_verbs.verbs")
        result: str | int | None = getattr(verbs, options.verb)(options)
    except EndedBySignal as ended:
        return int(ended.args[0])
    except BrokenPipeError:
        # The reader of a pipe has gone (`| head -1`). What is still buffered must go nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except RuntimeError as error:
        return str(error)
    return result
