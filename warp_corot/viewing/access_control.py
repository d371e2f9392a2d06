"""Access control: a check of every request to the page's server before anything is answered.

Any page in a browser can send requests. Without a token, a request must name this computer itself, so that no other
name on the network can be made to mean it, and websockets must come from the page itself. With a token, every request
must contain it, at first in the address, later in a cookie.
"""

from __future__ import annotations

import hmac
import http
import http.cookies
import secrets
import socket
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qs, quote, urlsplit

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count, shown

#: Names by which a browser may address its own computer.
LOOPBACK = ("localhost", "127.0.0.1", "::1")


def is_loopback(host: str) -> bool:
    """Whether an address can be reached only from this computer.

    Raises:
        InputError: The address is not a text.
    """
    if not isinstance(host, str):
        raise InputError(f"host is {shown(host)}; it must be an address of this computer")
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def new_token() -> str:
    """A token that cannot be guessed."""
    return secrets.token_urlsafe(16)


class AccessControl:
    """Lets requests pass or refuses them.

    Args:
        host: The address on which the server listens.
        token: The token that requests must contain; None: they must come from this computer.

    Raises:
        InputError: There is no token although others can reach the address, or it is empty.
    """

    def __init__(self, host: str, token: str | None = None):
        if token is not None and not (isinstance(token, str) and token.strip()):
            given = "empty" if isinstance(token, str) else shown(token)
            raise InputError(f"token is {given}; it must be a word that only those who may enter know")
        if token is None and not is_loopback(host):
            raise InputError(f"host is {host}, which others can reach; it must have a token")
        self.host, self.token = host, token
        self._cookie = "warp-corot-" + secrets.token_hex(4)

    def address(self, port: int) -> str:
        """The address to open in a browser."""
        host = "localhost" if self.host in ("0.0.0.0", "::", "") else self.host
        shown = f"http://{f'[{host}]' if ':' in host else host}:{port}/"
        return shown if self.token is None else f"{shown}?token={quote(self.token, safe='')}"

    def refusal(self, path: str, headers: Any) -> tuple[http.HTTPStatus, dict[str, str]] | None:
        """The status and the headers of the refusal of a request; None if it may pass.

        Args:
            path: The path with its query.
            headers: A mapping of names; case does not matter.
        """
        forbidden: tuple[http.HTTPStatus, dict[str, str]] = (http.HTTPStatus.FORBIDDEN, {})
        try:
            host = headers.get("Host") or ""
            origin = headers.get("Origin")
            if self.token is None and urlsplit(f"//{host}").hostname not in (*LOOPBACK, self.host):
                return forbidden
            if origin is not None and urlsplit(origin).netloc != host:
                return forbidden
            if self.token is None or self._has_cookie(headers):
                return None
            given = parse_qs(urlsplit(path).query).get("token", [])
        except Exception:  # a request that cannot be read is refused
            return forbidden
        if len(given) != 1 or not self._is_token(given[0]):
            return forbidden
        if (headers.get("Upgrade") or "").lower() == "websocket":
            return None
        # From now on the address bar, the history and the referrer do not contain the token.
        cookie = f"{self._cookie}={quote(given[0], safe='')}; HttpOnly; SameSite=Strict; Path=/"
        return http.HTTPStatus.SEE_OTHER, {"Location": urlsplit(path).path or "/", "Set-Cookie": cookie}

    def _has_cookie(self, headers: Any) -> bool:
        jar = http.cookies.SimpleCookie(headers.get("Cookie") or "")
        found = jar.get(self._cookie)
        assert self.token is not None
        return found is not None and hmac.compare_digest(
            found.value.encode(errors="surrogatepass"), quote(self.token, safe="").encode()
        )

    def _is_token(self, given: str) -> bool:
        assert self.token is not None
        return hmac.compare_digest(given.encode(errors="surrogatepass"), self.token.encode())


def check_port(host: str, port: int) -> None:
    """Check that a port is free; 0 stands for any free port.

    Raises:
        InputError: It is not, or this computer does not have the address.
    """
    if checked_count(port, "port", least=0) > 65535:
        raise InputError(f"port is {port}; it must be 0 to 65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tried.bind(address)
    except OSError as error:
        if isinstance(error, socket.gaierror):
            raise InputError(f"host is {host!r}; it must be an address of this computer") from None
        why = error.strerror or str(error)
        raise InputError(f"port {port} of {host} cannot be opened ({why}); use a free one, or 0 for any") from None
