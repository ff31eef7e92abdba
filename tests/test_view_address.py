"""Who is let in to the page of a run."""

from __future__ import annotations

import socket

import pytest

from hapticbridge.errors import HapticBridgeError
from hapticbridge.view.address import COOKIE, Address

OUTSIDE = "127.0.0.2"
"""An address of this machine that counts as reachable by others."""


def outside() -> Address:
    try:
        return Address(OUTSIDE, 0)
    except HapticBridgeError:
        pytest.skip(f"this system has no {OUTSIDE}")


@pytest.mark.parametrize(
    ("host", "origin", "reason"),
    [
        ("127.0.0.1:8080", None, ""),
        ("localhost:8080", "http://localhost:8080", ""),
        ("[::1]:8080", "http://[::1]:8080", ""),
        ("evil.example:8080", None, "not the host"),
        ("127.0.0.1.evil.example", None, "not the host"),
        ("", None, "not the host"),
        ("[::1", None, "not the host"),
        ("127.0.0.1:8080", "http://evil.example", "another page"),
        ("127.0.0.1:8080", "http://127.0.0.1:9999", "another page"),
        ("127.0.0.1:8080", "https://127.0.0.1:8080", "another page"),
        ("127.0.0.1:8080", "null", "another page"),
    ],
)
def test_on_loopback_only_its_own_page_is_answered(
    host: str, origin: str | None, reason: str
) -> None:
    headers = {"Host": host} | ({} if origin is None else {"Origin": origin})
    said = Address("127.0.0.1", 8080).refusal("/", headers)
    assert (reason in said) if reason else said == ""


def test_another_address_asks_for_a_token_that_nobody_guesses() -> None:
    first, second = outside(), outside()
    assert first.token != second.token
    assert len(first.token) >= 32
    assert first.token not in repr(first)
    assert first.url(80) == f"http://{OUTSIDE}:80/?token={first.token}"
    assert Address("127.0.0.1", 8080).token == ""


@pytest.mark.parametrize("way", ["query", "cookie"])
def test_token_opens_and_nothing_else_does(way: str) -> None:
    address = outside()

    def said(token: str) -> str:
        headers = {"host": f"{OUTSIDE}:80"}
        if way == "cookie":
            return address.refusal("/", headers | {"cookie": f"a=b; {COOKIE}={token}"})
        return address.refusal(f"/x?a=b&token={token}", headers)

    assert said(address.token) == ""
    for wrong in ("", address.token[:-1], address.token + "x", "ü", address.token.swapcase()):
        assert "token" in said(wrong)
    assert "token" in address.refusal("/", {"host": OUTSIDE})
    assert "token" in address.refusal("//[", {"host": OUTSIDE})  # no path that can be read


def test_a_name_that_may_be_bound_anew_is_refused_and_a_number_is_not() -> None:
    address = outside()
    path = f"/?token={address.token}"
    assert address.refusal(path, {"host": "192.168.7.7:80"}) == ""
    assert address.refusal(path, {"host": f"{socket.gethostname()}:80"}) == ""
    assert "not the host" in address.refusal(path, {"host": "evil.example:80"})


@pytest.mark.parametrize(
    ("host", "port", "told"),
    [
        ("127.0.0.1", 65536, "port is 65536"),
        ("127.0.0.1", -1, "port is -1"),
        ("192.0.2.1", 8080, "host '192.0.2.1'"),
        ("no such host", 8080, "host 'no such host'"),
    ],
)
def test_an_address_that_cannot_be_served_is_refused(host: str, port: int, told: str) -> None:
    with pytest.raises(HapticBridgeError, match=told):
        Address(host, port)
