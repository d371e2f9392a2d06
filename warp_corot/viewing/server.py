"""The web server of a page: its files, and a websocket for each visitor, both behind access control.

Any page in a browser can send requests. Without a token, a request must name this computer itself, so that no other
name on the network can be made to mean it, and websockets must come from the page itself. With a token, every request
must contain it, at first in the address, later in a cookie. Messages to the browser are binary: the length of a header,
the header as JSON, and arrays. Messages from it are JSON, or a picture that it was asked for.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import http
import http.cookies
import itertools
import json
import logging
import queue
import secrets
import socket
import threading
from collections.abc import Callable
from concurrent.futures import Future
from importlib import resources
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qs, quote, urlsplit

import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count, shown

# --- access control: a check of every request before anything is answered --------------------------------------------

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
            if self.token is None:
                return None
            jar = http.cookies.SimpleCookie(headers.get("Cookie") or "")
            if (found := jar.get(self._cookie)) is not None and _are_same(found.value, quote(self.token, safe="")):
                return None
            given = parse_qs(urlsplit(path).query).get("token", [])
        except Exception:  # a request that cannot be read is refused
            return forbidden
        if len(given) != 1 or not _are_same(given[0], self.token):
            return forbidden
        if (headers.get("Upgrade") or "").lower() == "websocket":
            return None
        # From now on the address bar, the history and the referrer do not contain the token.
        cookie = f"{self._cookie}={quote(given[0], safe='')}; HttpOnly; SameSite=Strict; Path=/"
        return http.HTTPStatus.SEE_OTHER, {"Location": urlsplit(path).path or "/", "Set-Cookie": cookie}


def _are_same(given: str, secret: str) -> bool:
    return hmac.compare_digest(given.encode(errors="surrogatepass"), secret.encode(errors="surrogatepass"))


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


# --- the server ------------------------------------------------------------------------------------------------------

#: The types of the page's files, by the ends of their names.
TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript"}
#: The browser loads nothing from elsewhere.
POLICY = "default-src 'self'; img-src 'self' data: blob:"
#: The longest message of a browser, which is a picture [bytes].
LONGEST = 1 << 24
#: Frames on their way to a browser: while it draws one, the next is sent.
AHEAD = 2


def library() -> Any:
    """The package that speaks the protocol of websockets.

    Raises:
        InputError: It is not installed.
    """
    try:
        import websockets.asyncio.server as servers
    except ImportError as error:
        raise InputError(f'the page needs websockets ({error}): pip install "warp-corot[view]"') from None
    return servers


def packed(header: dict[str, Any], *arrays: npt.NDArray[Any] | bytes) -> bytes:
    """A message to a browser: a header's length, the header, and arrays, each of which begins at a multiple of four."""
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    parts = [len(text).to_bytes(4, "little"), text]
    for array in arrays:
        part = array if isinstance(array, bytes) else array.tobytes()
        parts += [b"\0" * (-len(parts[-1]) % 4), part]
    return b"".join(parts)


class Visitor:
    """A browser that has the page open.

    Attributes:
        number: Its number.
        sent: What it knows already, by kind.
    """

    def __init__(self, number: int, socket: Any, loop: asyncio.AbstractEventLoop):
        self.number, self.sent = number, dict[str, Any]()
        self._socket, self._loop = socket, loop
        self._credit = threading.BoundedSemaphore(AHEAD)
        self._pictures: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def takes_frame(self) -> bool:
        """Whether it has drawn enough of the last frames to get another one; it is then expected to get one."""
        return self._credit.acquire(blocking=False)

    def send(self, message: bytes) -> None:
        """Send a message; may be called from any thread."""
        with contextlib.suppress(RuntimeError):  # the server has ended
            asyncio.run_coroutine_threadsafe(self._send(message), self._loop)

    def drawn(self, width: int, height: int, patience: float) -> bytes:
        """The picture that it shows now, as PNG.

        Args:
            width, height: Pixels.
            patience: The longest time to wait [s].

        Raises:
            RuntimeError: The browser has left, or does not draw.
        """
        while not self._pictures.empty():
            self._pictures.get()
        self.send(packed({"kind": "draw", "width": width, "height": height}))
        try:
            return self._pictures.get(timeout=patience)
        except queue.Empty:
            raise RuntimeError("the browser does not draw; its tab must be visible") from None

    def got(self, message: str | bytes) -> Any:
        """The command in a message of the browser; None if there is none."""
        if isinstance(message, bytes):
            self._pictures.put(message)
            return None
        command = json.loads(message)
        if command == {"do": "drawn"}:
            self._credit.release()
            return None
        return command

    async def _send(self, message: bytes) -> None:
        with contextlib.suppress(Exception):  # it has left
            await self._socket.send(message)


class Server:
    """The web server.

    Args:
        gate: Decides who may enter.
        port: The port, 0 for any free one.
        take: Called with each command and its visitor, on the server's thread.
        left: Called with each visitor that has left, on the server's thread.

    Attributes:
        port: The port.
        visitors: Who has the page open, by number.

    Raises:
        InputError: websockets is not installed, or the port is taken.
    """

    def __init__(
        self, gate: AccessControl, port: int, take: Callable[[Visitor, Any], None], left: Callable[[Visitor], None]
    ):
        self._library = library()
        check_port(gate.host, port)
        self._gate, self._take, self._left = gate, take, left
        self.visitors: dict[int, Visitor] = {}
        self._numbers = itertools.count()
        folder = resources.files(__package__) / "page"
        self._files = {path.name: path.read_bytes() for path in folder.iterdir()}
        self._loop, self._over = asyncio.new_event_loop(), asyncio.Event()
        opened: Future[int] = Future()
        self._thread = threading.Thread(target=self._run, args=(port, opened), name="warp_corot server", daemon=True)
        self._thread.start()
        self.port = opened.result()

    def close(self) -> None:
        """Stop, and send everyone away."""
        with contextlib.suppress(RuntimeError):  # it has stopped already
            self._loop.call_soon_threadsafe(self._over.set)
        self._thread.join()

    def _run(self, port: int, opened: Future[int]) -> None:
        try:
            self._loop.run_until_complete(self._serve(port, opened))
        except OSError as error:
            opened.set_exception(InputError(f"port {port} of {self._gate.host} cannot be opened ({error.strerror})"))
        finally:
            self._loop.close()

    async def _serve(self, port: int, opened: Future[int]) -> None:
        quiet = logging.getLogger(__name__)
        quiet.addHandler(logging.NullHandler())  # else visitors that break off are reported on stderr
        options = {"process_request": self._answer, "compression": None, "max_size": LONGEST, "logger": quiet}
        host = self._gate.host.strip("[]")
        async with self._library.serve(self._visit, host, port, close_timeout=1.0, **options) as server:
            opened.set_result(next(iter(server.sockets)).getsockname()[1])
            await self._over.wait()

    def _answer(self, connection: Any, request: Any) -> Any:
        """The answer to a request; None for a websocket that may be opened."""
        refused = self._gate.refusal(request.path, request.headers)
        if refused is not None:
            status, told = refused
            body = b"" if told else b"The page is closed to this request; open the address with its token.\n"
            return _response(status, body, {"Content-Type": "text/plain", **told})
        if (request.headers.get("Upgrade") or "").lower() == "websocket":
            return None
        name = request.path.partition("?")[0].strip("/") or "index.html"
        if name not in self._files:
            return _response(http.HTTPStatus.NOT_FOUND, b"There is no such file.\n", {"Content-Type": "text/plain"})
        told = {"Content-Type": f"{TYPES[name.rpartition('.')[2]]}; charset=utf-8", "Content-Security-Policy": POLICY}
        return _response(http.HTTPStatus.OK, self._files[name], {"Cache-Control": "no-cache", **told})

    async def _visit(self, socket: Any) -> None:
        from websockets.exceptions import ConnectionClosed

        visitor = Visitor(next(self._numbers), socket, self._loop)
        self.visitors[visitor.number] = visitor
        with contextlib.suppress(ConnectionClosed):
            async for message in socket:
                with contextlib.suppress(ValueError):  # no JSON, or a frame that was not sent
                    command = visitor.got(message)
                    if command is not None:
                        self._take(visitor, command)
        del self.visitors[visitor.number]
        self._left(visitor)


def _response(status: http.HTTPStatus, body: bytes, told: dict[str, str]) -> Any:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    headers = Headers(**{"Content-Length": str(len(body)), "X-Content-Type-Options": "nosniff", **told})
    return Response(status, status.phrase, headers, body)
