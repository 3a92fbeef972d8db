"""Who may reach the page: addresses, names, origins and the token; and who commands the limb."""

from __future__ import annotations

import hmac
import ipaddress
import math
import secrets
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

SHORTEST_TOKEN = 12
"""A token that somebody sets has at least this many characters."""
LOOPBACK_NAMES = ("127.0.0.1", "localhost", "::1")
SAFE_METHODS = ("GET", "HEAD")
KEPT = 15.0
"""The desk is kept for an operator whose browser is silent for this time [s]."""
LOADED_ANEW = 1.0
"""Silence of a window after which another of the same tab is the same window, loaded anew [s]."""
HEADERS = (
    (b"x-frame-options", b"DENY"),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
    # The page's framework compiles its templates in the browser, hence 'unsafe-eval'. Nothing may
    # be loaded from, or sent to, another machine, and no other page may show this one in a frame.
    (
        b"content-security-policy",
        b"default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
        b"style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
        b"connect-src 'self'; frame-ancestors 'none'; form-action 'self'; base-uri 'self'",
    ),
)


class AccessError(ValueError):
    """The page may not be served like this; the message names the parameter and the remedy."""


@dataclass(frozen=True)
class Binding:
    """Where the page listens, and the secret that opens it.

    Attributes:
        address: IP address to listen on.
        port: TCP port; 0 lets the system choose one.
        token: what a browser must know; drawn at random unless it is given.
        host_names: further names by which browsers reach the page.

    Raises:
        AccessError: the address is no IP address, or the token is too short.
    """

    address: str = "127.0.0.1"
    port: int = 8080
    token: str = field(default_factory=secrets.token_urlsafe)
    host_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        try:
            ipaddress.ip_address(self.address)
        except ValueError as error:
            raise AccessError(
                f"parameter 'address' is '{self.address}', which is no IP address: give one of "
                "this machine's, or 127.0.0.1"
            ) from error
        if len(self.token) < SHORTEST_TOKEN:
            raise AccessError(
                f"parameter 'token' has {len(self.token)} characters: give it {SHORTEST_TOKEN} or "
                "more, or leave it empty for one that is drawn at random"
            )

    @property
    def loopback(self) -> bool:
        """Whether only this machine can reach the address."""
        return ipaddress.ip_address(self.address).is_loopback

    def url(self, port: int) -> str:
        """Return the address of the page, without its token, at the port that is listened on."""
        host = f"[{self.address}]" if ":" in self.address else self.address
        return f"http://{host}:{port}/"

    def names(self) -> frozenset[str]:
        """Return the names under which the page answers.

        A page elsewhere whose name is pointed at this machine (DNS rebinding) still sends its own
        name in the Host header, so that only names that are listed may pass.
        """
        names = {name.lower() for name in self.host_names}
        address = ipaddress.ip_address(self.address)
        if address.is_loopback or address.is_unspecified:
            names.update(LOOPBACK_NAMES)
        if address.is_unspecified:
            names.update(_own_addresses())
        else:
            names.add(self.address)
        return frozenset(names)

    def listen(self) -> socket.socket:
        """Return a bound socket, so that a taken port is known before anything starts.

        Raises:
            AccessError: the address is not this machine's, or the port is taken.
        """
        family = socket.AF_INET6 if ":" in self.address else socket.AF_INET
        both = family == socket.AF_INET6  # "::" is every address, also of the older kind
        place = (self.address, self.port)
        try:
            return socket.create_server(place, family=family, dualstack_ipv6=both)
        except OSError as error:
            raise AccessError(
                f"{error.strerror}: set the parameter 'port' to a free one, 'address' to one of "
                "this machine's"
            ) from error


def _own_addresses() -> set[str]:
    """Return this machine's name and the IP addresses that the name has."""
    name = socket.gethostname()
    try:
        found = {str(entry[4][0]).split("%")[0] for entry in socket.getaddrinfo(name, None)}
    except OSError:
        found = set()
    return {name.lower(), *found}


class AccessFilter:
    """An ASGI layer around the page that refuses requests of others than the page itself.

    Every request and websocket must name a known host, must not come from another page, and must
    carry the token: in the address at first, and then in a cookie that the answer has set.

    Args:
        app: the page.
        binding: names and token.
        port: that is listened on; it names the cookie, since a machine's pages share cookies.
    """

    def __init__(self, app: ASGIApp, binding: Binding, port: int) -> None:
        self._app = app
        self._names = binding.names()
        self._token = binding.token
        self._cookie = f"limb_token_{port}"
        self.refused = 0
        """Requests that were refused."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it, or exchange the address's token for the cookie."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message["headers"], *HEADERS]}
            await send(message)

        request = HTTPConnection(scope)
        changes = scope["type"] == "websocket" or scope["method"] not in SAFE_METHODS
        objection = self._objection(request, changes)
        answer: ASGIApp = self._app
        if objection:
            answer = self._refusal(scope, 403, objection)
        elif not changes and self._is_token(request.query_params.get("token", "")):
            answer = self._exchange_token(request)
        elif not self._is_token(request.cookies.get(self._cookie, "")):
            text = "this page needs its token: open the address that it printed when it started"
            answer = self._refusal(scope, 401, text)
        await answer(scope, receive, send_with_headers)

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self._token.encode())

    def _objection(self, request: HTTPConnection, changes: bool) -> str:
        """Return why a request is refused whatever its token; empty if it is not."""
        hosts, origins = request.headers.getlist("host"), request.headers.getlist("origin")
        if len(hosts) != 1 or _host_name(hosts[0]) not in self._names:
            return (
                f"this page does not answer to the name '{', '.join(hosts)}': open it by its "
                "address, or add the name to the parameter 'host_names'"
            )
        own = (f"http://{hosts[0]}".lower(), f"https://{hosts[0]}".lower())
        site = request.headers.get("sec-fetch-site", "none")
        follows_link = request.headers.get("sec-fetch-mode") == "navigate"
        foreign = site not in ("same-origin", "none") and not follows_link
        if foreign or any(origin.lower() not in own for origin in origins):
            return "requests from other pages are refused: only the page itself may ask"
        if changes and len(origins) != 1:
            return "a command or a websocket must say its origin: use the page in a browser"
        return ""

    def _exchange_token(self, request: HTTPConnection) -> Response:
        """Lead a browser to the address without the token, which it keeps in a cookie instead."""
        url = request.url.remove_query_params("token")
        # Without scheme and host, which are others before a reverse proxy.
        answer = RedirectResponse(f"{url.path}{url.query and '?'}{url.query}", status_code=303)
        answer.set_cookie(self._cookie, self._token, httponly=True, samesite="lax")
        return answer

    def _refusal(self, scope: Scope, status: int, text: str) -> ASGIApp:
        self.refused += 1
        if scope["type"] == "http":
            return PlainTextResponse(text, status)

        async def close(scope: Scope, receive: Receive, send: Send) -> None:
            await WebSocket(scope, receive, send).close(1008, text[:100])

        return close


def _host_name(host: str) -> str | None:
    """Return the name in a Host header without its port; None if it holds none."""
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


class Desk:
    """The place of the one window that commands the limb; all others watch.

    A window takes the desk if it is free, and loses it when it leaves, or when its browser has not
    been heard for `KEPT`. A window that is loaded anew in its tab has another name and keeps it,
    once the one before has been silent for `LOADED_ANEW`: a copy of the tab does not get it.

    Args:
        clock: steady [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._tabs: dict[str, str] = {}  # of each window
        self._holder = ""
        self._heard = -math.inf

    @property
    def operator(self) -> str | None:
        """Name of the window that commands; None: nobody does."""
        return self._holder if self._holder and self._age <= KEPT else None

    @property
    def silence(self) -> float | None:
        """Time [s] since the operator's browser has shown life; None: nobody commands."""
        return None if self.operator is None else self._age

    @property
    def _age(self) -> float:
        return self._clock() - self._heard

    def take(self, window: str) -> bool:
        """Take the desk if it is free; tell whether the window now has it."""
        if self.operator is None:
            self._holder, self._heard = window, self._clock()
        return self.operator == window

    def hear(self, window: str, tab: str) -> None:
        """Note that a window's browser has answered just now, and the window's tab."""
        self._tabs[window] = tab
        same = self.operator is not None and self._tabs.get(self._holder) == tab
        if same and self._age > LOADED_ANEW:
            self._holder = window
        if window == self.operator:
            self._heard = self._clock()

    def leave(self, window: str) -> None:
        """Give the desk up on purpose: nothing is lost."""
        if self._holder == window:
            self._holder = ""

    def may_command(self, window: str) -> bool:
        """Tell whether a window has the desk."""
        return self.operator == window
