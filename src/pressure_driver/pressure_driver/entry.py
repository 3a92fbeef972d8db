"""What `ros2 run pressure_driver` starts: each function is one process."""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import select
import signal
import socket
import sys
import time
from collections import deque
from functools import partial
from typing import Any

from pressure_driver.board import BoardProcess
from pressure_driver.lines import Channel
from pressure_driver.port_process import explain, stable_name
from pressure_driver.protocols import SettingError
from pressure_driver.safety import Mode
from pressure_driver.settings import Settings, declarations


def _run_node(module: str) -> int:
    """Run a node, so that what comes is served soon, also while other nodes come and go.

    All threads are favoured alike, where that is permitted: one of lower priority may hold a lock.
    Publications are asynchronous unless the user has chosen a mode: `rclpy` holds Python's lock
    while it publishes, and a synchronous publication waits for locks of the middleware.
    """
    from limb_interfaces.entry import run_module  # noqa: PLC0415 - `board` runs without

    with contextlib.suppress(OSError):
        os.nice(-15)
    os.environ.setdefault("RMW_FASTRTPS_PUBLICATION_MODE", "ASYNCHRONOUS")
    return int(run_module(module))


pressure_driver = partial(_run_node, "pressure_driver.node")
board_emulator = partial(_run_node, "pressure_driver.emulator.node")
topic_board = partial(_run_node, "pressure_driver.topic_board.node")


class Terminal(Channel):
    """Takes the place of the node when the process of the port is started by hand."""

    def __init__(self, port: str) -> None:
        super().__init__(socket.socket())
        self._port = port
        self._lines: deque[str] = deque()
        self._shown_at = 0.0
        self._count = 0

    def fileno(self) -> int:
        """Return the descriptor to wait for."""
        return sys.stdin.fileno()

    def send(self, *message: Any, descriptor: int | None = None) -> None:  # noqa: ARG002
        """Print a message; the state once a second."""
        word, *content = message
        if word == "state" and time.monotonic() - self._shown_at >= 1.0:
            self._shown_at = time.monotonic()
            state = content[0]
            measured = [round(value, 0) for value in state["measured_chamber"]]
            commanded = state["commanded_differential"]
            mode = Mode(state["mode"]).name
            print(mode, "commanded", commanded, "measured", measured, flush=True)
        elif word == "failed":
            print(explain(self._port, OSError(*content)), flush=True)
        elif word in ("log", "answer", "ended"):
            print(content[1] if word == "answer" else content[0], flush=True)

    def receive(self) -> tuple[list[Any], int | None]:
        """Return the next line as a message; the end of the lines ends the process.

        Raises:
            BlockingIOError: there is no line.
        """
        if not self._lines:
            if not select.select([self], [], [], 0.0)[0]:
                raise BlockingIOError
            text = os.read(self.fileno(), 4096).decode()
            self._lines += text.splitlines() if text else ["end"]
        words = self._lines.popleft().lower().split() or ["alive"]
        self._count += 1
        with contextlib.suppress(ValueError):
            pressures = [float(word) for word in words]
            return ["setpoint", 0, pressures, "", 0, 0, "", self._count, True], None
        if words[0] not in ("arm", "vent", "end", "alive"):
            print(
                f"{words} is no order: write arm, vent or one pressure [Pa] a segment", flush=True
            )
            words = ["alive"]
        return words[:1], None


def true_or_false(text: str) -> bool:
    """Return what a switch is set to.

    Raises:
        ValueError: it is neither; argparse names it and this function.
    """
    return bool(("false", "true").index(text.lower()))


def board() -> int:
    """Run the process of the port by hand, with an option for each parameter of the driver."""
    parser = argparse.ArgumentParser(
        prog="board", description="Drive a valve board: arm, vent, or one pressure [Pa] a segment."
    )
    for name, declaration, default in declarations(Settings):
        kind = true_or_false if isinstance(default, bool) else type(default)
        parser.add_argument(
            f"--{name.replace('_', '-')}",
            type=kind,
            default=default,
            metavar="|".join(declaration.choices) or type(default).__name__.upper(),
            help=f"{declaration.description} (%(default)s)",
        )
    given = vars(parser.parse_args())
    given["port"] = stable_name(given["port"])
    try:
        settings = Settings(**given)
    except SettingError as error:
        parser.error(str(error))
    process = BoardProcess(settings, Terminal(settings.port), math.inf)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, process.end)
    return process.run()
