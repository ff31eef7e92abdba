"""Where the page is served, and who is let in.

On loopback alone unless another address is asked for; then nobody gets in without a random token.
A browser also sends requests that a foreign page made it send: those carry that page's Origin, or,
where a name was bound anew to this machine, a foreign Host. Both are refused.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from hapticbridge.arguments import Arguments
from hapticbridge.errors import HapticBridgeError

LOOPBACK = ("127.0.0.1", "localhost", "::1")
"""Addresses that only this machine reaches."""

COOKIE = "hapticbridge_token"


@dataclass(frozen=True, slots=True)
class Address:
    """Where a page is served.

    Attributes:
        host: Address to listen on; one of ``LOOPBACK`` needs no token.
        port: 1 to 65535, or 0 for any that is free.
        token: What a visitor must show; empty on loopback.

    Raises:
        HapticBridgeError: The port is out of range, or the host no address of this machine.
    """

    host: str = LOOPBACK[0]
    port: int = 8080
    token: str = field(default="", repr=False)

    def __post_init__(self) -> None:
        Arguments(HapticBridgeError).whole("port", self.port, least=0, most=65535)
        try:
            found = socket.getaddrinfo(self.host or None, None, type=socket.SOCK_STREAM)
            with socket.socket(found[0][0], socket.SOCK_STREAM) as probe:
                probe.bind((found[0][4][0], 0))
        except OSError as error:
            raise HapticBridgeError(
                f"cannot serve a page on host '{self.host}': {error.strerror or error}"
            ) from None
        if not self.is_loopback and not self.token:
            object.__setattr__(self, "token", secrets.token_urlsafe(24))

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine reaches it."""
        return self.host in LOOPBACK

    def url(self, port: int) -> str:
        """Returns what to open in a browser.

        Args:
            port: The one that it is truly served on.
        """
        name = socket.gethostname() if self.host in ("0.0.0.0", "::", "") else self.host
        name = f"[{name}]" if ":" in name else name
        return f"http://{name}:{port}/" + (f"?token={self.token}" if self.token else "")

    def refusal(self, path: str, headers: Mapping[str, str]) -> str:
        """Returns why a request is not answered, or nothing.

        Args:
            path: Of the request, with its query.
            headers: Of the request; names in any case.
        """
        given = {name.lower(): value for name, value in headers.items()}
        host = given.get("host", "")
        if not self._is_own(host):
            return "this is not the host of this page"
        origin = given.get("origin")
        if origin is not None and origin != f"http://{host}":
            return "a request made by another page is refused"
        if self.token and not self._is_shown(path, given.get("cookie", "")):
            return "the token is missing or wrong; open the address that hapticbridge printed"
        return ""

    def is_in_query(self, path: str) -> bool:
        """Returns whether a request's path carries the token, which a cookie is then to keep."""
        try:
            shown = parse_qs(urlsplit(path).query).get("token", [""])[0]
        except ValueError:  # no path at all
            return False
        return bool(self.token) and _are_equal(shown, self.token)

    def _is_own(self, host: str) -> bool:
        try:
            name = urlsplit(f"http://{host}").hostname or ""
        except ValueError:
            return False
        if self.is_loopback:
            return name in LOOPBACK
        if name in {"localhost", socket.gethostname().lower(), self.host.lower()}:
            return True
        try:
            ipaddress.ip_address(name)  # a name may be bound anew by its owner, a number cannot
        except ValueError:
            return False
        return True

    def _is_shown(self, path: str, cookie: str) -> bool:
        if self.is_in_query(path):
            return True
        try:
            jar = SimpleCookie(cookie)
        except CookieError:
            return False
        return COOKIE in jar and _are_equal(jar[COOKIE].value, self.token)


def _are_equal(shown: str, token: str) -> bool:
    return hmac.compare_digest(shown.encode(), token.encode())
