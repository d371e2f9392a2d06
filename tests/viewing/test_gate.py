"""Access to the page: without a token from this computer only, with one for those who bring it; everything else is
refused."""

import contextlib
import http.client
import json
import socket
import time

import pytest
from hands import block

import warp_corot as wc
from warp_corot.viewing.server import AccessControl, is_loopback
from warp_corot.viewing.view import View

WEBSOCKET = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}


def status(gate, path="/", **headers):
    refused = gate.refusal(path, {name.replace("_", "-"): value for name, value in headers.items()})
    return None if refused is None else int(refused[0])


@pytest.mark.parametrize(
    ("headers", "passes"),
    [
        ({"Host": "127.0.0.1:8080"}, True),
        ({"Host": "localhost:8080", "Origin": "http://localhost:8080"}, True),
        ({"Host": "[::1]:8080"}, True),
        ({"Host": "evil.example:8080"}, False),
        ({"Host": "127.0.0.1.evil.example"}, False),
        ({"Host": "localhost:8080", "Origin": "http://evil.example"}, False),
        ({"Host": "localhost:8080", "Origin": "http://localhost:9999"}, False),
        ({"Host": "localhost:8080", "Origin": "null"}, False),
        ({}, False),
        ({"Host": "[::1"}, False),
    ],
)
def test_without_a_token_only_this_computer(headers, passes):
    assert status(AccessControl("127.0.0.1"), **headers) == (None if passes else 403)


def test_with_a_token_only_those_who_bring_it():
    gate = AccessControl("0.0.0.0", "open sesame")
    here = {"Host": "192.168.0.7:8080"}
    assert status(gate, **here) == 403
    for query in ("token=", "token=open", "token=open+sesame+", "token=Open+sesame", "other=open+sesame"):
        assert status(gate, f"/?{query}", **here) == 403, query
    assert status(gate, "/?token=open+sesame&token=open+sesame", **here) == 403
    assert status(gate, "/?token=\udc80", **here) == 403
    assert status(gate, "/?token=open+sesame", Upgrade="websocket", **here) is None
    code, told = gate.refusal("/?token=open%20sesame", here)
    assert int(code) == 303
    assert told["Location"] == "/"
    assert "HttpOnly" in told["Set-Cookie"]
    assert "SameSite=Strict" in told["Set-Cookie"]
    cookie = told["Set-Cookie"].partition(";")[0]
    assert status(gate, Cookie=cookie, **here) is None
    assert status(gate, Cookie=cookie, Upgrade="websocket", **here) is None
    assert status(gate, Cookie=cookie, Origin="http://evil.example", **here) == 403
    assert status(gate, Cookie=cookie + "x", **here) == 403
    assert status(AccessControl("0.0.0.0", "open sesame"), Cookie=cookie.replace("=", "x=", 1), **here) == 403


def test_no_token_where_others_come_is_refused():
    for host in ("0.0.0.0", "192.168.0.7", "::", "example.org"):
        assert not is_loopback(host)
        with pytest.raises(wc.InputError, match="it must have a token"):
            AccessControl(host)
    for token in ("", "  "):
        with pytest.raises(wc.InputError, match="token is empty"):
            AccessControl("127.0.0.1", token)


def test_the_address_tells_the_token():
    assert AccessControl("127.0.0.1").address(8080) == "http://127.0.0.1:8080/"
    assert AccessControl("0.0.0.0", "a b&c").address(80) == "http://localhost:80/?token=a%20b%26c"
    assert AccessControl("::1", "x").address(80) == "http://[::1]:80/?token=x"


# --- the server itself -----------------------------------------------------------------------------------------------


@pytest.fixture
def opened():
    pytest.importorskip("websockets")
    pages = []

    def open_page(**options):
        pages.append(View(block(level=3), port=0, **options))
        return pages[-1]

    yield open_page
    for page in pages:
        page.close()


def answered(page, path="/", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=5)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    body = b"" if answer.status == 101 else answer.read()
    connection.close()
    return answer.status, dict(answer.getheaders()), body


def test_the_server_asks_of_files_and_websockets_alike(opened):
    page = opened(token="word")
    for headers in ({}, WEBSOCKET, {**WEBSOCKET, "Upgrade": "WebSocket"}):
        for path in ("/", "/index.html", "/?token=", "/?token=wrong", "/no-such-file"):
            code, _, body = answered(page, path, **headers)
            assert code == 403, (path, headers)
            assert b"<html" not in body.lower()
    code, told, _ = answered(page, "/?token=word")
    assert code == 303
    cookie = told["Set-Cookie"].partition(";")[0]
    code, _, body = answered(page, "/", Cookie=cookie)
    assert code == 200
    assert b"<canvas" in body
    assert answered(page, "/", Cookie=cookie, **WEBSOCKET)[0] == 101
    assert answered(page, "/?token=word", **WEBSOCKET)[0] == 101


def test_the_server_without_a_token_is_this_computer_s(opened):
    page = opened()
    assert answered(page)[0] == 200
    assert answered(page, Host="evil.example")[0] == 403
    assert answered(page, Origin="http://evil.example", **WEBSOCKET)[0] == 403
    assert answered(page, **WEBSOCKET)[0] == 101


def test_the_server_gives_out_the_page_s_files_only(opened):
    page = opened()
    for name, kind in (("index.html", "text/html"), ("page.js", "text/javascript"), ("style.css", "text/css")):
        code, told, _ = answered(page, f"/{name}?1")
        assert (code, told["Content-Type"].partition(";")[0]) == (200, kind)
        assert "default-src 'self'" in told["Content-Security-Policy"]
    for path in ("/../view.py", "/page/index.html", "/%2e%2e/view.py", "/__init__.py"):
        assert answered(page, path)[0] == 404


def test_visitors_that_break_off_leave_no_trace(opened, capfd):
    from websockets.sync.client import connect

    page = opened()
    with socket.create_connection(("127.0.0.1", page.port)) as broken:
        broken.sendall(b"no HTTP\r\n\r\n")
    visitor = connect(page.address.replace("http", "ws"))
    until(lambda: page._server.visitors, "the visitor is there")
    visitor.socket.shutdown(socket.SHUT_RDWR)
    until(lambda: not page._server.visitors, "the visitor has left")
    page.close()
    assert capfd.readouterr().err == ""


def test_messages_that_ask_for_nothing_do_no_harm(opened):
    from websockets.sync.client import connect

    page = opened()
    with connect(page.address.replace("http", "ws")) as socket:
        for message in (
            "{",
            "[]",
            "3",
            '{"do": "import"}',
            '{"do": "press", "body": -1, "at": [0, 0, 0]}',
            b"no picture",
        ):
            socket.send(message)
        wrong = [
            {"do": "change", "what": {"fps": 1e9}},
            {"do": "change", "what": {"speed": float("inf")}},
            {"do": "tissue", "what": {"young": "__import__"}},
            {"do": "save", "what": "/etc/passwd", "seconds": 1},
            {"do": "use tool", "name": "ball", "at": [1, 2]},
        ]
        for asked in wrong:
            before = page.session.controls
            socket.send(json.dumps(asked))
            until(lambda: page.session._commands.qsize(), "the message has come")
            page.session.note = ""
            page.session.take_commands()
            assert page.session.note, asked
            assert page.session.controls == before
    page.session.advance()


def test_a_browser_gets_frames_as_fast_as_it_draws_them(opened):
    from websockets.sync.client import connect

    page = opened()
    with connect(page.address.replace("http", "ws"), max_size=None) as socket:
        until(lambda: page._server.visitors, "the visitor is there")

        def kinds():
            """What comes after ten frames' time."""
            for _ in range(10):
                page._show()
            found = []
            with contextlib.suppress(TimeoutError):
                while True:
                    message = socket.recv(timeout=0.5)
                    found.append(json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])["kind"])
            return found

        assert kinds() == ["page", "topology", "frame", "frame"]
        socket.send('{"do": "drawn"}')
        until(lambda: page._server.visitors[0]._credit._value == 1, "it is known")
        assert kinds() == ["frame"]
        page.session.change(colors="displacement")
        socket.send('{"do": "drawn"}')
        until(lambda: page._server.visitors[0]._credit._value == 1, "it is known")
        assert kinds() == ["page", "frame"]


def until(true, what):
    """Wait until a condition holds."""
    end = time.monotonic() + 10.0
    while not true():
        assert time.monotonic() < end, f"{what}: not within 10 s"
        time.sleep(0.01)


def test_a_port_that_is_taken_is_one_clear_line(opened):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(wc.InputError, match=rf"port {port} of .* cannot be opened \(Address already in use\)"):
            View(block(level=3), port=port)
    with pytest.raises(wc.InputError, match="port is 99999; it must be 0 to 65535"):
        View(block(level=3), port=99999)
    with pytest.raises(wc.InputError, match="it must be an address of this computer"):
        View(block(level=3), host="no.such.host.invalid", token="word", port=0)
    for wrong, said in (({"port": "a"}, "port is 'a'"), ({"host": 5}, "host is 5"), ({"token": 5}, "token is 5")):
        with pytest.raises(wc.InputError, match=said):
            View(block(level=3), **wrong)
    with pytest.raises(wc.InputError, match="wait is 'x'"):
        wc.view(block(level=3), wait="x")


def test_without_websockets_the_page_says_what_to_install(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "websockets", None)
    with pytest.raises(wc.InputError, match=r'pip install "warp-corot\[view\]"'):
        View(block(level=3), port=0)


def test_a_page_is_of_a_simulation():
    with pytest.raises(wc.InputError, match="it must be a Simulation"):
        wc.view(3)


def test_a_page_in_a_thread_of_its_own(opened, capsys):
    sim = block(level=3)
    with wc.view(sim, port=0, wait=False) as page:
        assert page.address in capsys.readouterr().out
        assert f'src="{page.address}"' in page._repr_html_()
        with page.held() as held:
            time = held.time
            assert held is sim
        page.session.ask(page.session.reset)
        with page.held() as held:
            assert held.time >= 0.0
        assert time >= 0.0
    page.close()
    assert "closed" in repr(page)
    assert sim.system.forces == []
    with pytest.raises(OSError):  # noqa: PT011 (whatever the system says of a port where nobody listens)
        socket.create_connection(("127.0.0.1", page.port), timeout=1.0).close()
