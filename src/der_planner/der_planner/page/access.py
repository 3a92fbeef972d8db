"""Who may reach the page: addresses, names, origins, passwords and sessions."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import math
import secrets
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

SHORTEST_PASSWORD = 12
"""Characters: a limb is not defended by a word from a dictionary."""
SESSION_LIFE = 12 * 3600.0
"""[s] without a sign of a browser after which the password is asked for again. A window that is
open says something all the time: its vent must not be refused because a shift was long."""
LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")


class AccessError(ValueError):
    """The page may not be served like this; the message names the parameter and the remedy."""


@dataclass(frozen=True)
class Binding:
    """Where the page listens, and what protects it there.

    Attributes:
        address: IP address to listen on.
        port: TCP port; 0 lets the system choose one.
        password: asked for by the page; empty: none, which only a loopback address may have.
        certificate: PEM file of the TLS certificate; empty: plain HTTP.
        private_key: PEM file of its key.
        host_names: further names by which browsers reach the page.
    """

    address: str = "127.0.0.1"
    port: int = 8080
    password: str = ""
    certificate: str = ""
    private_key: str = ""
    host_names: tuple[str, ...] = ()

    @property
    def scheme(self) -> str:
        """`https` with a certificate, else `http`."""
        return "https" if self.certificate else "http"

    @property
    def loopback(self) -> bool:
        """Whether only this machine can reach the address."""
        return ipaddress.ip_address(self.address).is_loopback

    def check(self) -> None:
        """Refuse a binding that lets strangers command a limb.

        Raises:
            AccessError: no IP address; an address that others reach without password or without
                TLS; a password that is too short; a certificate without its key, or a file missing.
        """
        try:
            loopback = self.loopback
        except ValueError as error:
            raise AccessError(
                f"parameter 'address' is '{self.address}', which is no IP address: give one of "
                "this machine's, or 127.0.0.1"
            ) from error
        if bool(self.certificate) != bool(self.private_key):
            raise AccessError(
                "parameters 'certificate' and 'private_key' belong together: set both"
            )
        for name, file in (("certificate", self.certificate), ("private_key", self.private_key)):
            if file and not Path(file).is_file():
                raise AccessError(f"parameter '{name}' names {file}, which is not there")
        if self.password and len(self.password) < SHORTEST_PASSWORD:
            raise AccessError(
                f"the password in 'password_file' has {len(self.password)} characters: "
                f"{SHORTEST_PASSWORD} or more are needed"
            )
        if loopback:
            return
        if not self.password:
            raise AccessError(
                f"parameter 'address' is {self.address}, which other machines reach: set "
                "'password_file' to a file with a password, and 'certificate' and 'private_key' "
                "for TLS, or leave the address at 127.0.0.1"
            )
        if not self.certificate:
            raise AccessError(
                f"parameter 'address' is {self.address}, which other machines reach: without TLS "
                "the password travels in the clear: set 'certificate' and 'private_key' (PEM)"
            )

    def hosts(self, port: int) -> frozenset[str]:
        """Return the values of the Host header that are answered.

        A page elsewhere whose name is pointed at this machine (DNS rebinding) still sends its own
        name in Host, so that only names that are listed may pass.

        Args:
            port: that is really listened on.
        """
        names = set(self.host_names)
        address = ipaddress.ip_address(self.address)
        if address.is_loopback or address.is_unspecified:
            names.update(LOOPBACK_NAMES)
        if address.is_unspecified:
            names.update(own_addresses())
        else:
            names.add(bracketed(self.address))
        default = 443 if self.certificate else 80
        hosts = {f"{name.lower()}:{port}" for name in names}
        if port == default:
            hosts.update(name.lower() for name in names)
        return frozenset(hosts)


def bracketed(address: str) -> str:
    """Return an IP address as it stands in an address line: IPv6 in brackets."""
    return f"[{address}]" if ":" in address else address


def own_addresses() -> set[str]:
    """Return this machine's name and the IP addresses that the name has."""
    name = socket.gethostname()
    try:
        found = {str(entry[4][0]) for entry in socket.getaddrinfo(name, None)}
    except OSError:
        found = set()
    return {name.lower(), *(bracketed(address.split("%")[0]) for address in found)}


def read_password(path: str) -> str:
    """Return the first line of a password file, an empty string without a file.

    Raises:
        AccessError: the file cannot be read, is empty, or others may read it.
    """
    if not path:
        return ""
    file = Path(path)
    try:
        readable_by_others = file.stat().st_mode & 0o077
        lines = file.read_text().splitlines()
    except OSError as error:
        raise AccessError(f"parameter 'password_file': {path}: {error.strerror}") from error
    if readable_by_others:
        raise AccessError(f"others may read the password: chmod 600 {path}")
    if not lines or not lines[0]:
        raise AccessError(f"parameter 'password_file': the first line of {path} is empty")
    return lines[0]


def same_origin(origin: str, host: str, scheme: str) -> bool:
    """Tell whether a request's Origin is the page itself.

    Args:
        origin: header of the request.
        host: header of the request, checked already.
        scheme: http or https, as served.
    """
    parts = urlsplit(origin)
    return parts.scheme == scheme and parts.netloc.lower() == host.lower()


class Sessions:
    """Who has given the password.

    Args:
        password: empty: nobody is asked.
        clock: steady [s].
    """

    def __init__(self, password: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._password = password
        self._clock = clock
        self._until: dict[bytes, float] = {}

    @property
    def needed(self) -> bool:
        """Whether a password is asked for."""
        return bool(self._password)

    def open(self, password: str) -> str | None:
        """Return the token of a new session, None for a wrong password."""
        if not hmac.compare_digest(_digest(password), _digest(self._password)):
            return None
        now = self._clock()
        self._until = {key: until for key, until in self._until.items() if until > now}
        token = secrets.token_urlsafe(32)
        self._until[_digest(token)] = now + SESSION_LIFE
        return token

    def holds(self, token: str) -> bool:
        """Tell whether a token belongs to a session that is still open; use keeps it open."""
        if not self.needed:
            return True
        key, now = _digest(token), self._clock()
        if self._until.get(key, -math.inf) <= now:
            return False
        self._until[key] = now + SESSION_LIFE
        return True


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode()).digest()


def listen(binding: Binding) -> socket.socket:
    """Return a socket that is bound, so that a taken port is known before anything starts.

    Raises:
        AccessError: the address is not this machine's, or the port is taken.
    """
    family = socket.AF_INET6 if ":" in binding.address else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((binding.address, binding.port))
    except OSError as error:
        listener.close()
        raise AccessError(
            f"cannot listen on {binding.address}, port {binding.port} ({error.strerror}): set "
            "the parameter 'port' to a free one, 'address' to one of this machine's"
        ) from error
    return listener


def tokens_of(cookies: Sequence[str], name: str) -> list[str]:
    """Return the values of one cookie in Cookie headers."""
    pairs = [part.strip().partition("=") for line in cookies for part in line.split(";")]
    return [value for key, _, value in pairs if key == name]
