"""What the commands share: steps and bars, exit codes, places of results, options of loads."""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import functools
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

from der_planner.limb import Limb, LimbError, Load


class OptionError(ValueError):
    """The command line or the hardware file asks for something impossible; says what and why."""


class Progress:
    """Prints steps to stderr; redraws a bar on a terminal, prints it rarely elsewhere."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._last_shown = -1e9
        self._open_line = False
        self.newest = "begins"
        """What has been said last, for who shows it elsewhere."""
        self.failed = False
        """Whether `newest` says why the command has failed."""

    def say(self, text: str) -> None:
        """Print one line."""
        self.newest = text.strip()
        self._end_bar()
        self._print(text)

    def fail(self, text: str) -> None:
        """Print why the command has failed."""
        self.say(f"error: {text}")
        self.newest, self.failed = text, True

    def bar(self, done: float, total: float, text: str, unit: str = "s") -> None:
        """Show that ``done`` of ``total`` seconds, or of another unit, are over."""
        self.newest = f"{text} {max(done, 0.0):.0f} of {total:.0f} {unit}"
        now = time.monotonic()
        finished = done >= total
        if now - self._last_shown < (0.2 if self._terminal else 15.0) and not finished:
            return
        self._last_shown = -1e9 if finished else now
        share = min(max(done / total, 0.0), 1.0) if total > 0 else 1.0
        line = f"  [{'#' * int(30 * share):<30}] {max(done, 0.0):5.0f} / {total:.0f} {unit} {text}"
        if self._terminal:
            width = shutil.get_terminal_size().columns - 1  # a wrapped line is not overwritten
            self._print(f"\r{line[:width]:<{width}}", end="")
            self._open_line = True
            if finished:
                self._end_bar()
        else:
            self._print(line)

    def _end_bar(self) -> None:
        if self._open_line:
            self._print("")
            self._open_line = False

    def _print(self, text: str, end: str = "\n") -> None:
        """Print; a terminal that was closed must not keep anybody from venting the limb."""
        with contextlib.suppress(OSError):
            print(text, end=end, file=sys.stderr, flush=True)


def interrupt_once() -> None:
    """Turn the first signal that ends a run into a KeyboardInterrupt with its name.

    The signals are `limb_interfaces.entry.END_SIGNALS`; later ones are ignored, so that they do not
    cut the venting short.
    """
    # Without ROS there is nothing to vent, and this package is not there.
    from limb_interfaces.entry import on_end_signals  # noqa: PLC0415

    def interrupt(number: int, _frame: FrameType | None) -> None:
        on_end_signals(signal.SIG_IGN)
        raise KeyboardInterrupt(signal.Signals(number).name)

    def lost(dropped: sys.UnraisableHookArgs) -> None:
        if dropped.exc_type is not KeyboardInterrupt:
            sys.__unraisablehook__(dropped)
            return
        # Python drops what is raised while it deletes an object: the signal comes once more.
        on_end_signals(interrupt)
        number = signal.Signals[str(dropped.exc_value)]
        threading.Timer(0.1, os.kill, (os.getpid(), number)).start()

    sys.unraisablehook = lost
    on_end_signals(interrupt)


def command(
    *failures: type[Exception], stopped: str = "", code: int = 1
) -> Callable[[Callable[[argparse.ArgumentParser], int]], Callable[[], int]]:
    """Return a decorator for the main function of a command: why it ended early is said on stderr.

    The function gets a parser whose --help shows the text of its module as it stands. Its exit code
    is 2 for options that cannot be, and for results that cannot be written where they are wanted;
    130 after a signal.

    Args:
        failures: what may go wrong besides the options and the places of results.
        stopped: what a user who stopped the command has to know.
        code: of a failure.
    """

    def decorate(work: Callable[[argparse.ArgumentParser], int]) -> Callable[[], int]:
        @functools.wraps(work)
        def main() -> int:
            parser = argparse.ArgumentParser(
                description=sys.modules[work.__module__].__doc__,
                formatter_class=argparse.RawDescriptionHelpFormatter,
            )
            try:
                return work(parser)
            except OptionError as error:
                ended, said = 2, f"error: {error}"
            except failures as error:
                ended, said = code, f"error: {error}"
            except KeyboardInterrupt as error:
                ended = 130
                said = f"stopped by {error or 'SIGINT'}{stopped and '; '}{stopped}"
            with contextlib.suppress(OSError):  # the terminal may have gone
                print(said, file=sys.stderr)
            return ended

        return main

    return decorate


# Places of results: known to be writable before hours of work, not after -----------------------


def check_file(path: Path, option: str = "--out") -> None:
    """Refuse a path at which no file can be written; nothing is left behind.

    Raises:
        OptionError: it is a folder, or its folder cannot be made or written.
    """
    try:
        if path.is_dir():
            raise OptionError(f"{option} {path} is a folder: name a file")
        if path.exists():
            path.open("ab").close()
            return
    except OSError as error:
        raise OptionError(f"{option} {path} cannot be written: {error.strerror}") from error
    _try_folder(Path(os.path.realpath(path)).parent, f"{option} {path}")


def check_limb_file(path: Path) -> None:
    """Refuse a path at which no new limb file can be written.

    Raises:
        OptionError: as `check_file`, or there is a file: a calibration is not lost unseen.
    """
    check_file(path)
    if path.exists():
        raise OptionError(f"--out {path} is there already: limb files are kept, name another one")


def check_folder(path: Path, option: str = "--out") -> None:
    """Refuse a path at which no folder can be made or written; nothing is left behind.

    Raises:
        OptionError: a file is in the way, or no file can be made there.
    """
    _try_folder(path.absolute(), f"{option} {path}")


def _try_folder(path: Path, named: str) -> None:
    """Make a file in a folder, or in what is there of it, and remove it again."""
    present = path
    try:
        while not present.exists() and present != present.parent:
            present = present.parent
        if not present.is_dir():
            raise OptionError(f"{named} cannot be made: {present} is no folder")
        with tempfile.TemporaryFile(dir=present):
            pass  # as root, and on read-only disks, only a trial tells
    except OSError as error:
        raise OptionError(f"{named} cannot be written: {error.strerror} in {present}") from error


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keep other commands that write their results there out of a folder, which is made.

    Raises:
        OptionError: one is in it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OptionError(
                f"--out {folder} is in use by another run of this command: wait for its end, or "
                "choose another folder"
            ) from error
        yield


# Loads -------------------------------------------------------------------------------------------


def given_load(given: argparse.Namespace) -> Load:
    """Return the load of a command line that has `add_load_options`.

    Raises:
        OptionError: the place of no payload.
    """
    if given.payload_at is not None and not given.payload:
        raise OptionError("--payload-at is the place of a payload: give --payload, too")
    return Load(given.payload, given.payload_at or 0.0, given.mounting)


def loaded(limb: Limb, load: Load) -> Limb:
    """Return a limb under the load of a command line.

    Raises:
        OptionError: the mounting is unknown, or the payload is too heavy or not on the limb.
    """
    try:
        return limb.loaded(load)
    except LimbError as error:
        raise OptionError(str(error)) from error


def add_load_options(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Add --mounting, --payload and --payload-at."""
    parser.add_argument(
        "--mounting",
        default="",
        help="horizontal, hanging, standing, sideways, or degrees by which a level limb is tilted "
        "about its straight axis, left side up (without it: the gravity of the limb file)",
    )
    parser.add_argument(
        "--payload",
        type=float,
        default=0.0,
        metavar="KG",
        help="mass that the limb carries in the run, beside the masses of its limb file",
    )
    parser.add_argument(
        "--payload-at",
        type=float,
        metavar="M",
        help="where the payload sits, along the limb from its clamp (0, or without it: the tip)",
    )
