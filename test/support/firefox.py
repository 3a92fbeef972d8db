"""A Firefox that tests drive by its own protocol (WebDriver BiDi), without geckodriver."""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
import subprocess
import time
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

FIREFOX = shutil.which("firefox-esr") or shutil.which("firefox")
PATIENCE = 60.0
"""[s] for Firefox to start, or to answer, on a loaded machine."""
QUIET = {
    "app.update.enabled": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "network.captive-portal-service.enabled": False,
    "network.connectivity-service.enabled": False,
}
"""Settings without which Firefox speaks to its makers."""


class Firefox:
    """One window of 1280 x 800.

    Args:
        folder: for its profile.
    """

    def __init__(self, folder: Path) -> None:
        assert FIREFOX is not None
        profile = folder / "firefox"
        profile.mkdir()
        lines = [f'user_pref("{key}", {json.dumps(value)});' for key, value in QUIET.items()]
        (profile / "user.js").write_text("\n".join(lines))
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self._process = subprocess.Popen(
            [FIREFOX, "--headless", "--profile", profile, f"--remote-debugging-port={port}"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            self._socket = self._connect(f"ws://127.0.0.1:{port}/session")
            self._asked = 0
            self._ask("session.new", {"capabilities": {}})
            tree = self._ask("browsingContext.getTree", {})
            self._window = {"context": tree["contexts"][0]["context"]}
            size = {"width": 1280, "height": 800}
            self._ask("browsingContext.setViewport", {**self._window, "viewport": size})
        except BaseException:
            self.quit()
            raise

    def _connect(self, address: str) -> ClientConnection:
        end = time.monotonic() + PATIENCE
        while True:
            try:
                return connect(address, max_size=None)
            except OSError:
                if time.monotonic() > end or self._process.poll() is not None:
                    raise
                time.sleep(0.05)

    def _ask(self, method: str, parameters: dict[str, Any]) -> Any:
        self._asked += 1
        self._socket.send(json.dumps({"id": self._asked, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=PATIENCE))
            if answer.get("id") == self._asked:
                assert answer["type"] == "success", answer
                return answer["result"]

    def get(self, address: str) -> None:
        """Open a page."""
        self._ask("browsingContext.navigate", {**self._window, "url": address, "wait": "complete"})

    def value(self, expression: str) -> Any:
        """Return what an expression is in the page, as JSON can carry it."""
        wanted = {"expression": f"JSON.stringify({expression})", "awaitPromise": False}
        found = self._ask("script.evaluate", {**wanted, "target": self._window})
        assert found["type"] == "success", found
        return json.loads(found["result"].get("value", "null"))

    def press(self, key: str) -> None:
        """Press and release a key."""
        actions = [{"type": kind, "value": key} for kind in ("keyDown", "keyUp")]
        self._act({"type": "key", "id": "keys", "actions": actions})

    def click(self, element: str) -> None:
        """Press and release the mouse in the middle of what an expression names."""
        box = f"{element}.getBoundingClientRect()"
        x, y, across, down = self.value(f"[{box}.x, {box}.y, {box}.width, {box}.height]")
        place = {"x": round(x + across / 2), "y": round(y + down / 2)}
        actions = [
            {"type": "pointerMove", **place},
            {"type": "pointerDown", "button": 0},
            {"type": "pointerUp", "button": 0},
        ]
        self._act({"type": "pointer", "id": "mouse", "actions": actions})

    def _act(self, source: dict[str, Any]) -> None:
        self._ask("input.performActions", {**self._window, "actions": [source]})

    def quit(self) -> None:
        """End it."""
        self._process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(10.0)
        self._process.kill()
        self._process.wait()
