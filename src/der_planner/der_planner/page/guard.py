"""An ASGI layer around the whole page that lets only the page itself speak to its server."""

from __future__ import annotations

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from der_planner.page.access import Sessions, same_origin, tokens_of

COOKIE = "limb_session"
LOGIN = "/login"
SAFE_METHODS = ("GET", "HEAD")
HEADERS = (
    (b"x-frame-options", b"DENY"),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
    # The page's framework compiles its templates in the browser, hence 'unsafe-eval'; nothing may
    # be loaded from, or sent to, another machine, and no other page may show this one in a frame.
    (
        b"content-security-policy",
        b"default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
        b"style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
        b"connect-src 'self'; frame-ancestors 'none'; form-action 'self'; base-uri 'self'",
    ),
)


class Guard:
    """Checks Host, Origin and session of every request and websocket before the page sees it.

    Args:
        app: the page.
        hosts: values of the Host header that are answered.
        scheme: http or https, as served.
        sessions: who has given the password.
    """

    def __init__(
        self, app: ASGIApp, hosts: frozenset[str], scheme: str, sessions: Sessions
    ) -> None:
        self.app = app
        self._hosts = hosts
        self._scheme = scheme
        self._sessions = sessions
        self.refused = 0
        """Requests refused because of their Host or Origin."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it with 403, or send it to the login page."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        reason = self._objection(scope)
        if reason:
            self.refused += 1
            await _refuse(scope, receive, send, 403, reason)
            return
        if scope["path"] != LOGIN and not self._logged_in(scope):
            if scope["type"] == "http" and scope["method"] in SAFE_METHODS:
                await _refuse(scope, receive, send, 303, "log in first", LOGIN)
            else:
                await _refuse(scope, receive, send, 401, "load this page anew and log in")
            return

        async def noted() -> Message:
            message = await receive()
            self._logged_in(scope)  # a window that only listens is in use, too
            return message

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message["headers"], *HEADERS]}
            await send(message)

        kept = scope["type"] == "websocket" and self._sessions.needed
        await self.app(scope, noted if kept else receive, with_headers)

    def _objection(self, scope: Scope) -> str:
        """Return why a request is refused; empty if it is not."""
        hosts, origins = _values(scope, b"host"), _values(scope, b"origin")
        if len(hosts) != 1 or hosts[0].lower() not in self._hosts:
            return (
                f"this page does not answer to the name '{', '.join(hosts)}': open it by its "
                "address, or add the name to the parameter 'host_names'"
            )
        if any(not same_origin(origin, hosts[0], self._scheme) for origin in origins):
            return f"requests from {', '.join(origins)} are refused: only the page itself may ask"
        site = _values(scope, b"sec-fetch-site")
        navigates = _values(scope, b"sec-fetch-mode") == ["navigate"]
        if any(value not in ("same-origin", "none") for value in site) and not navigates:
            return "requests from other pages are refused: only the page itself may ask"
        changes = scope["type"] == "websocket" or scope["method"] not in SAFE_METHODS
        if changes and len(origins) != 1:
            return "a command or a websocket must say its origin: use the page in a browser"
        return ""

    def _logged_in(self, scope: Scope) -> bool:
        if not self._sessions.needed:
            return True
        tokens = tokens_of(_values(scope, b"cookie"), COOKIE)
        return any(self._sessions.holds(token) for token in tokens)


def _values(scope: Scope, name: bytes) -> list[str]:
    return [value.decode("latin-1") for key, value in scope["headers"] if key == name]


async def _refuse(
    scope: Scope, receive: Receive, send: Send, status: int, text: str, location: str = ""
) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008, "reason": text[:100]})
        return
    headers = [(b"content-type", b"text/plain; charset=utf-8"), *HEADERS]
    if location:
        headers.append((b"location", location.encode()))
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": text.encode()})
