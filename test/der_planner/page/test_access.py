"""Where the page may listen, and whom it lets in."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from der_planner.page.access import (
    SESSION_LIFE,
    AccessError,
    Binding,
    Sessions,
    listen,
    read_password,
    same_origin,
)

PASSWORD = "correct horse battery"


@pytest.fixture
def pem(tmp_path: Path) -> dict[str, str]:
    files = {}
    for name in ("certificate", "private_key"):
        path = tmp_path / f"{name}.pem"
        path.write_text("any")
        files[name] = str(path)
    return files


@pytest.mark.parametrize("address", ["127.0.0.1", "127.0.0.5", "::1"])
def test_a_loopback_address_needs_no_password(address: str) -> None:
    Binding(address=address).check()


@pytest.mark.parametrize("address", ["0.0.0.0", "192.168.1.4", "::"])
def test_other_addresses_need_a_password_and_tls(address: str, pem: dict[str, str]) -> None:
    with pytest.raises(AccessError, match=r"password_file.*certificate.*TLS"):
        Binding(address=address).check()
    with pytest.raises(AccessError, match=r"TLS.*certificate"):
        Binding(address=address, password=PASSWORD).check()
    Binding(address=address, password=PASSWORD, **pem).check()


def test_what_is_half_given_is_refused(pem: dict[str, str]) -> None:
    with pytest.raises(AccessError, match="set both"):
        Binding(certificate=pem["certificate"]).check()
    with pytest.raises(AccessError, match="not there"):
        Binding(certificate=pem["certificate"], private_key="/nowhere.pem").check()
    with pytest.raises(AccessError, match="12 or more"):
        Binding(password="short").check()
    with pytest.raises(AccessError, match="no IP address"):
        Binding(address="localhost:8080").check()


def test_only_listed_names_are_answered() -> None:
    assert Binding().hosts(8080) == {"127.0.0.1:8080", "localhost:8080", "[::1]:8080"}
    assert "lab.example:8080" in Binding(host_names=("Lab.example",)).hosts(8080)
    assert "127.0.0.1:8080" not in Binding(address="192.168.1.4").hosts(8080)
    assert "192.168.1.4" in Binding(address="192.168.1.4", certificate="c").hosts(443)


@pytest.mark.parametrize(
    ("origin", "same"),
    [
        ("http://127.0.0.1:8080", True),
        ("https://127.0.0.1:8080", False),
        ("http://127.0.0.1:8081", False),
        ("http://127.0.0.1:8080.evil.example", False),
        ("http://evil.example", False),
        ("null", False),
    ],
)
def test_an_origin_is_scheme_name_and_port(origin: str, same: bool) -> None:
    assert same_origin(origin, "127.0.0.1:8080", "http") is same


def test_the_password_file_is_for_its_owner_only(tmp_path: Path) -> None:
    file = tmp_path / "password"
    file.write_text(PASSWORD + "\n")
    file.chmod(0o644)
    with pytest.raises(AccessError, match="chmod 600"):
        read_password(str(file))
    file.chmod(0o600)
    assert read_password(str(file)) == PASSWORD
    assert read_password("") == ""
    file.write_text("")
    with pytest.raises(AccessError, match="empty"):
        read_password(str(file))


def test_a_session_opens_with_the_password_and_ends() -> None:
    now = 0.0
    sessions = Sessions(PASSWORD, lambda: now)
    assert sessions.open("wrong") is None
    token = sessions.open(PASSWORD)
    assert token is not None
    assert sessions.holds(token)
    assert not sessions.holds(token + "x")
    assert not sessions.holds("")
    for now in (0.9 * SESSION_LIFE, 1.8 * SESSION_LIFE):  # noqa: B007 - read by the clock
        assert sessions.holds(token)
    now += SESSION_LIFE + 1.0
    assert not sessions.holds(token)


def test_a_taken_port_is_named_with_the_remedy() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(AccessError, match=f"port {port}.*set the parameter 'port'"):
            listen(Binding(port=port))
