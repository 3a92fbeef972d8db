"""Whether the nodes' processes still run, where they run on the page's own computer.

Diagnostics come once a second, so that their silence tells of a dead node only after more than
that. Each node names its computer and process in them: here the operating system is asked instead.
"""

from __future__ import annotations

import socket

import psutil

ENDED, STOPPED = "its process has ended", "its process is stopped"


class Processes:
    """The processes that nodes have named, by the name of the node."""

    def __init__(self) -> None:
        self._host = socket.gethostname()
        self._known: dict[str, tuple[str, psutil.Process | None]] = {}

    def note(self, node: str, identity: str) -> None:
        """Take what a node's diagnostics say under ``process``: ``HOST:NUMBER``, or nothing.

        A process that is not seen here, as on another computer or in another container, is never
        said to have ended.
        """
        if self._known.get(node, ("", None))[0] == identity:
            return
        host, _, number = identity.rpartition(":")
        process = None
        if host == self._host and number.isdigit():
            try:
                process = psutil.Process(int(number))
            except psutil.Error:
                process = None
        self._known[node] = (identity, process)

    def trouble(self, node: str) -> str:
        """Return `ENDED`, `STOPPED`, or an empty text: it runs, or nothing is known of it."""
        process = self._known.get(node, ("", None))[1]
        if process is None:
            return ""
        try:
            # Another process may have got the number since: then this one is not running any more.
            status = process.status() if process.is_running() else psutil.STATUS_DEAD
        except psutil.NoSuchProcess:
            return ENDED
        except psutil.Error:
            return ""
        if status in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD):
            return ENDED
        return STOPPED if status == psutil.STATUS_STOPPED else ""
