"""Signals that end a run: the first interrupts it, a second must not cut the venting short."""

from __future__ import annotations

import signal
from types import FrameType

from limb_interfaces.entry import END_SIGNALS


def interrupt_once() -> None:
    """Turn the first of `END_SIGNALS` into a KeyboardInterrupt with its name; ignore later ones."""
    for each in END_SIGNALS:
        signal.signal(each, _interrupt)


def _interrupt(number: int, _frame: FrameType | None) -> None:
    for each in END_SIGNALS:
        signal.signal(each, signal.SIG_IGN)
    raise KeyboardInterrupt(signal.Signals(number).name)
