"""What the guard keeps out, tried from outside over real connections."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
import pytest
from tests.app.browser import ROOT, Server
from tests.systems import needs_posix
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from sightline.app.web.guard import MAX_BODY_BYTES, MAX_SOCKETS, Guard, is_loopback
from sightline.app.web.serve import serve as start
from sightline.app.web.transfers import MAX_UPLOAD_BYTES
from sightline.errors import UnusableInputError

TOKEN = "correct-horse-battery"  # noqa: S105
SOCKET = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
POLLING = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"


@dataclass
class App:
    """The address that the small app reported."""

    url: str
    port: int
    image: str
    upload: str
    routes: list[str]

    @property
    def base(self) -> str:
        return f"http://127.0.0.1:{self.port}"


def told(server: Server) -> App:
    return App(**json.loads(server.log.read_text().partition("\n")[0]))


@pytest.fixture(scope="module")
def open_app(serve: Callable[..., Server]) -> App:
    return told(serve("tests.app.small_app", "{port}"))


@pytest.fixture(scope="module")
def locked_app(serve: Callable[..., Server]) -> App:
    return told(serve("tests.app.small_app", "{port}", TOKEN))


def ask(app: App, path: str, **headers: str) -> httpx.Response:
    return httpx.get(app.base + path, headers=headers)


def socket_url(app: App) -> str:
    return f"ws://127.0.0.1:{app.port}{SOCKET}"


def raw(port: int, *lines: str, body: bytes = b"") -> bytes:
    """The first bytes answered to a request written by hand."""
    with socket.create_connection(("127.0.0.1", port), timeout=20) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode() + body)
        return connection.recv(4096)


def test_the_page_is_served_with_headers_that_keep_it_to_itself(open_app: App) -> None:
    answer = ask(open_app, "/")
    assert answer.status_code == 200
    policy = answer.headers["content-security-policy"]
    assert "default-src 'self'" in policy and "frame-ancestors 'none'" in policy
    assert "'unsafe-inline'" not in re.search(r"script-src [^;]*", policy)[0]  # type: ignore[index]
    nonce = re.search(r"'nonce-([^']+)'", policy)[1]  # type: ignore[index]
    scripts = re.findall(r"<script[^>]*>", answer.text)
    assert len(scripts) > 5 and all(f'nonce="{nonce}"' in script for script in scripts)
    assert "https://" not in policy and nonce not in ask(open_app, "/").text
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert answer.headers["cross-origin-opener-policy"] == "same-origin"
    assert "access-control-allow-origin" not in ask(open_app, POLLING).headers
    assert "server" not in answer.headers


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "LocalHost"])
def test_it_answers_to_loopback_names(open_app: App, name: str) -> None:
    assert ask(open_app, "/", host=f"{name}:{open_app.port}").status_code == 200


@pytest.mark.parametrize(
    "host",
    [
        "evil.example:{port}",
        "127.0.0.1.evil.example:{port}",
        "127.0.0.1:1",
        "127.0.0.1",
        "10.0.0.1:{port}",
        "",
        "a:b:{port}",
        "127.0.0.1:{port}:1",
        "127.0.0.1:{port}@evil.example",
    ],
)
def test_it_answers_to_no_other_name(open_app: App, host: str) -> None:
    host = host.format(port=open_app.port)
    assert ask(open_app, "/", host=host).status_code == 421
    assert raw(open_app.port, "GET / HTTP/1.0").startswith(b"HTTP/1.1 421")


def test_two_host_headers_are_refused(open_app: App) -> None:
    own = f"Host: 127.0.0.1:{open_app.port}"
    assert b" 200 " in raw(open_app.port, f"GET {open_app.image} HTTP/1.1", own)[:20]
    assert b" 200 " not in raw(open_app.port, f"GET {open_app.image} HTTP/1.1", own, "Host: evil.example")[:20]


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "http://127.0.0.1:{port}.evil.example",
        "null",
        "https://127.0.0.1:{port}",
        "http://127.0.0.1:1",
        "file://",
    ],
)
def test_a_foreign_origin_gets_nothing(open_app: App, origin: str) -> None:
    origin = origin.format(port=open_app.port)
    assert ask(open_app, open_app.image, origin=origin).status_code == 403
    assert ask(open_app, POLLING, origin=origin).status_code == 403
    assert httpx.post(open_app.base + open_app.upload, content=b"x", headers={"origin": origin}).status_code == 403
    with pytest.raises(InvalidStatus, match="403"), connect(socket_url(open_app), origin=origin):  # type: ignore[arg-type]
        pass


def test_what_changes_something_must_have_an_origin(open_app: App) -> None:
    assert httpx.post(open_app.base + open_app.upload, content=b"x").status_code == 403
    with pytest.raises(InvalidStatus, match="403"), connect(socket_url(open_app)):
        pass


def test_a_picture_asked_for_by_a_foreign_page_is_refused(open_app: App) -> None:
    foreign = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"}
    assert ask(open_app, open_app.image, **foreign).status_code == 403
    followed_link = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    assert ask(open_app, "/", **followed_link).status_code == 200


def test_only_the_methods_in_use(open_app: App) -> None:
    for method in ("PUT", "DELETE", "OPTIONS", "PATCH"):
        answer = httpx.request(method, open_app.base, headers={"origin": open_app.base})
        assert answer.status_code == 405


def test_a_forwarded_prefix_is_not_believed(open_app: App) -> None:
    assert "/elsewhere" not in ask(open_app, "/", **{"x-forwarded-prefix": "/elsewhere"}).text


def test_every_route_asks_for_the_token(locked_app: App) -> None:
    assert len(locked_app.routes) > 8
    for route in locked_app.routes:
        path = re.sub(r"\{[^}]*\}", "x", route)
        for method in ("GET", "POST", "HEAD"):
            answer = httpx.request(method, locked_app.base + path, headers={"origin": locked_app.base})
            assert answer.status_code == 401, (method, path)
    for path in ("/", locked_app.image, POLLING, "/no-such-page"):
        assert ask(locked_app, path).status_code == 401
    with pytest.raises(InvalidStatus, match="403"), connect(socket_url(locked_app), origin=locked_app.base):  # type: ignore[arg-type]
        pass


def test_the_token_becomes_a_cookie_and_leaves_the_address(locked_app: App) -> None:
    assert TOKEN in locked_app.url
    entered = httpx.get(locked_app.url)
    assert entered.status_code == 303 and entered.headers["location"] == "/"
    cookie = entered.headers["set-cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie and TOKEN not in cookie
    own = {"cookie": cookie.partition(";")[0]}
    assert ask(locked_app, "/", **own).status_code == 200
    assert ask(locked_app, locked_app.image, **own).status_code == 200
    with connect(socket_url(locked_app), origin=locked_app.base, additional_headers=own) as opened:  # type: ignore[arg-type]
        assert opened.recv(timeout=20)


@pytest.mark.parametrize("wrong", ["", "wrong", TOKEN[:-1], TOKEN + "x", "\u00fc"])
def test_a_wrong_token_opens_nothing(locked_app: App, wrong: str) -> None:
    answer = httpx.get(locked_app.base, params={"token": wrong})
    assert answer.status_code == 401 and "set-cookie" not in answer.headers
    assert ask(locked_app, "/", cookie=f"sightline-{locked_app.port}={wrong.encode().hex()}").status_code == 401


@pytest.mark.parametrize("kind", ["polling", "upload"])
def test_a_body_is_bounded_while_it_streams(open_app: App, kind: str) -> None:
    if kind == "polling":
        session = re.search(r'"sid":"([^"]+)"', ask(open_app, POLLING).text)[1]  # type: ignore[index]
        path, limit = f"{POLLING}&sid={session}", MAX_BODY_BYTES
    else:
        path, limit = open_app.upload, MAX_UPLOAD_BYTES

    def too_much() -> Iterator[bytes]:  # without a Content-Length
        yield from [b"\x93NUMPY" + bytes(2**20)] * (limit // 2**20 + 1)

    answer = httpx.post(open_app.base + path, content=too_much(), headers={"origin": open_app.base}, timeout=60)
    assert answer.status_code == 413
    assert ask(open_app, "/").status_code == 200


def test_a_body_announced_too_large_is_not_read(open_app: App) -> None:
    own = [f"Host: 127.0.0.1:{open_app.port}", f"Origin: {open_app.base}", f"Content-Length: {MAX_BODY_BYTES + 1}"]
    assert raw(open_app.port, f"POST {POLLING} HTTP/1.1", *own).startswith(b"HTTP/1.1 413")


def test_a_message_on_a_socket_is_bounded(open_app: App) -> None:
    with connect(socket_url(open_app), origin=open_app.base) as opened:  # type: ignore[arg-type]
        opened.recv(timeout=20)
        with pytest.raises(ConnectionClosed):
            opened.send("4" + "x" * 2 * MAX_BODY_BYTES)
            opened.recv(timeout=20)
    assert ask(open_app, "/").status_code == 200


def test_sockets_are_counted(open_app: App) -> None:
    with ExitStack() as opened:
        for _ in range(MAX_SOCKETS):
            opened.enter_context(connect(socket_url(open_app), origin=open_app.base))  # type: ignore[arg-type]
        with pytest.raises(InvalidStatus, match="403"), connect(socket_url(open_app), origin=open_app.base):  # type: ignore[arg-type]
            pass


def test_pixels_arrive_as_they_are(open_app: App) -> None:
    answer = ask(open_app, open_app.image)
    assert np.array_equal(np.frombuffer(answer.content, "<u2"), np.arange(512) * 100)
    assert answer.headers["content-encoding"] == "identity"
    assert answer.headers["cache-control"].startswith("private")
    assert ask(open_app, "/image/guessed.u16").status_code == 404


@needs_posix
@pytest.mark.parametrize("sign", [signal.SIGTERM])
def test_it_ends_in_order_and_leaves_nothing(tmp_path: Path, sign: signal.Signals) -> None:
    command = [sys.executable, "-m", "tests.app.small_app", "0"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, stdout=-1, stderr=-1, text=True, cwd=tmp_path, env=environment) as process:  # noqa: S603
        assert process.stdout is not None
        app = App(**json.loads(process.stdout.readline()))
        with connect(socket_url(app), origin=app.base):  # type: ignore[arg-type]
            process.send_signal(sign)
            out, err = process.communicate(timeout=30)
    assert (process.returncode, out.strip(), err) == (0, "ended in order", "")
    assert list(tmp_path.iterdir()) == []


def test_a_port_that_cannot_be_had_is_refused_with_advice(open_app: App) -> None:
    with pytest.raises(UnusableInputError, match="another --port"):
        start(lambda site: None, port=open_app.port)
    with pytest.raises(UnusableInputError, match="65535"):
        start(lambda site: None, port=open_app.port + 65536)


def test_others_are_let_in_by_token_alone() -> None:
    async def app(scope: object, receive: object, send: object) -> None: ...

    Guard(app, "127.0.0.1", 80)
    Guard(app, "0.0.0.0", 80, TOKEN)  # noqa: S104
    with pytest.raises(UnusableInputError, match="token"):
        Guard(app, "192.168.1.5", 80)
    with pytest.raises(UnusableInputError, match="longer"):
        Guard(app, "127.0.0.1", 80, "short")


ALONE = ["127.0.0.1", "127.9.9.9", "::1", "localhost"]
REACHABLE = ["0.0.0.0", "::", "10.0.0.1", "localhost.evil.example"]  # noqa: S104


@pytest.mark.parametrize("host", [*ALONE, *REACHABLE])
def test_which_addresses_are_this_machine_alone(host: str) -> None:
    assert is_loopback(host) == (host in ALONE)
