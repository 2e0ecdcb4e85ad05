"""Hostile requests to the app: it must answer, and disclose nothing.

The app runs in a separate process with a token, on a case with a decision; the requests use real connections. They have
the token and send what no page sends; those without it, or from foreign pages, are in tests/app/test_guard.py.
"""

import atexit
import json
import os
import re
import socket
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from unittest.mock import patch
from urllib.parse import quote

import httpx
import numpy as np
from tests.app.browser import Server
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from campaigns.campaign import Campaign, Damage, Ended
from campaigns.files import FILES, mutated
from sightline.case.journal import Actor, Case, Kind

TOKEN = "of-the-campaign-of-pages"  # noqa: S105
SECRET = "known-to-nobody"  # noqa: S105 - in a file next to the case
PATIENCE_S = 60.0  # for an answer, on a busy machine
ENGINE = "/_nicegui_ws/socket.io/?EIO=4&transport="
METHODS = ("GET", "POST", "HEAD", "PUT", "DELETE", "OPTIONS", "PATCH", "TRACE", "get", "\x00")
CLIMBS = ("../", "..%2f", "%2e%2e/", "..%5c", "....//", "%252e%252e%252f", "..;/", "//", "/./", "%00", "..%c0%af")
ODD = (None, True, -1, 1e308, "", "x" * 5000, "\u0000", [], {}, [[[]]], {"a": {"b": None}}, "<script>alert(1)</script>")
EVENTS = ("event", "handshake", "javascript_response", "ack", "log", "alive", "disconnect", "connect", "no such", "")


@dataclass(frozen=True)
class App:
    """The running app, and the cookie of a client with its token."""

    server: Server
    folder: Path
    cookie: str

    @property
    def base(self) -> str:
        """Its address."""
        return self.server.url.rstrip("/")

    @property
    def headers(self) -> dict[str, str]:
        """The headers that its own page sends."""
        return {"host": f"127.0.0.1:{self.server.port}", "origin": self.base, "cookie": self.cookie}

    def ask(self, path: str, method: str = "GET", **options) -> httpx.Response:
        """Return the response to a request."""
        return httpx.request(method, self.base + path, timeout=PATIENCE_S, **options)

    def raw(self, data: bytes) -> bytes:
        """Return the response to raw bytes, until the connection closes or is silent for 0.2 s."""
        answer = b""
        with socket.create_connection(("127.0.0.1", self.server.port), timeout=PATIENCE_S) as link, suppress(OSError):
            link.sendall(data)
            link.settimeout(0.2)
            while piece := link.recv(65536):
                answer += piece
        return answer

    def fault(self) -> str:
        """Return what is wrong with the app; "" if it still answers."""
        if self.server._process is None or self.server._process.poll() is not None:
            return "the app has ended"
        end_s = time.monotonic() + PATIENCE_S
        while (status := self.ask("/favicon.ico", headers=self.headers).status_code) == 503:
            if time.monotonic() > end_s:
                break
            time.sleep(0.1)
        if status != 200:
            return f"its own page is answered with {status}"
        log = (self.folder / "log.txt").read_text()
        bugs = re.findall(r'File "[^"]*/(sightline/[^"]*)", line (\d+)[^\n]*\n[^\n]*\n(?! +File)', log)
        return f"an error in {bugs[-1][0]}:{bugs[-1][1]}" if bugs else ""


@cache
def app() -> App:
    """Return the app of this process, started at first use."""
    folder = Path(mkdtemp(prefix="sightline-campaign-"))
    atexit.register(rmtree, folder, ignore_errors=True)
    (folder / "secret.txt").write_text(SECRET)
    with Case.create(folder / "case") as case:
        case.record(Kind.CHANGED, {"what": "note", "to": SECRET}, by=Actor.SURGEON)
    words = ("app", "--case", str(folder / "case"), "--port", "{port}", "--no-browser")
    with patch.dict(os.environ, {"SIGHTLINE_TOKEN": TOKEN}):
        server = Server(folder / "log.txt", "sightline", *words)
    atexit.register(server.stop)
    entered = httpx.get(f"{server.url}?token={TOKEN}", timeout=PATIENCE_S)
    return App(server, folder, entered.headers["set-cookie"].partition(";")[0])


@cache
def page() -> str:
    """Return the text of a page that stays open."""
    text = app().ask("/", headers=app().headers).text
    told = {"client_id": _client_in(text), "tab_id": "tab", "document_id": "document", "next_message_id": 0}
    opened = threading.Event()
    threading.Thread(target=_stay, args=[json.dumps(["handshake", told]), opened], daemon=True).start()
    assert opened.wait(PATIENCE_S)
    return text


def _stay(handshake: str, is_open: threading.Event) -> None:
    """Answer the server's pings, so that the page counts as open."""
    with suppress(WebSocketException), opened(app()) as link:
        link.send("40")
        link.send("42" + handshake)
        is_open.set()
        for message in link:
            if message == "2":
                link.send("3")


def _client_in(text: str) -> str:
    match = re.search(r"client_id\W+([\w-]{36})", text)
    assert match is not None, text[:500]
    return match[1]


def upload_address() -> str:
    """Return the path to which the page uploads images."""
    return re.findall(r"/upload/[\w-]+", page())[0]


Attack = Callable[[App, np.random.Generator], str]


def attack(play: Attack) -> Damage:
    """Return the class of one attack, which returns what was disclosed."""

    def make(rng: np.random.Generator) -> Ended:
        if disclosed := play(app(), rng):
            return Ended("unsafe", disclosed)
        fault = app().fault()
        return Ended("crash", fault) if fault else Ended("right")

    return Damage(make)


def told(answer: httpx.Response | bytes) -> str:
    """Return what a response must not contain; "" if nothing."""
    body = answer if isinstance(answer, bytes) else answer.content
    if SECRET.encode() in body or b"root:x:" in body:
        return "the content of a file"
    failed = body.startswith(b"HTTP/1.1 500") if isinstance(answer, bytes) else answer.status_code == 500
    return "an error 500" if failed else ""


def route(served: App, rng: np.random.Generator) -> str:
    """Return a random path of the app."""
    paths = ("/", upload_address(), ENGINE + "polling", "/image/x.u16", "/_nicegui/auto/static/nicegui.js", "/nothing")
    return paths[int(rng.integers(len(paths)))]


def opened(served: App) -> ClientConnection:
    """Open a socket."""
    address = f"ws://127.0.0.1:{served.server.port}{ENGINE}websocket"
    return connect(address, origin=served.base, additional_headers={"cookie": served.cookie}, open_timeout=PATIENCE_S)  # type: ignore[arg-type]


def malformed(served: App, rng: np.random.Generator) -> str:
    """Send a request with changed, doubled or missing bytes, and with wrong lengths."""
    body = bytes(rng.bytes(int(rng.integers(0, 400))))
    lengths = (str(len(body)), "-1", "99999999999", "1e9", "0", "", "+5")
    lines = [f"{rng.choice(METHODS)} {route(served, rng)} HTTP/{rng.choice(['1.1', '1.0', '9.9', '0'])}"]
    lines += [f"{name}: {value}" for name, value in served.headers.items()]
    lines += [f"Content-Length: {rng.choice(lengths)}"] * int(rng.integers(0, 3))
    lines += ["Transfer-Encoding: chunked"] * int(rng.integers(0, 2))
    data = "\r\n".join([*lines, "", ""]).encode() + body
    return told(served.raw(mutated(data, rng) if rng.random() < 0.7 else data))


def climbing(served: App, rng: np.random.Generator) -> str:
    """Request paths outside the served folders, in many encodings."""
    starts = ["/", "/_nicegui/", "/_nicegui/3.0/static/", "/_nicegui/auto/static/", "/image/", "/upload/"]
    start = str(rng.choice(starts))
    goal = str(rng.choice(["etc/passwd", "secret.txt", "case/journal.sqlite", str(served.folder / "secret.txt")]))
    path = start + "".join(rng.choice(CLIMBS, int(rng.integers(1, 12)))) + goal
    head = "\r\n".join(f"{name}: {value}" for name, value in served.headers.items())
    return told(served.raw(f"GET {path} HTTP/1.1\r\n{head}\r\nConnection: close\r\n\r\n".encode("latin-1", "replace")))


def uploads(served: App, rng: np.random.Generator) -> str:
    """Upload any file: an image, a damaged one, no image, an incomplete one; with hostile file names."""
    name = str(rng.choice(list(FILES)))
    data = FILES[name][0]()
    data = mutated(data, rng) if rng.random() < 0.6 else rng.bytes(int(rng.integers(0, 5000))) + data
    names = ["a.png", "../../evil.png", "/etc/passwd", "%2e%2e%2fx", "<b>", "\u202egnp.exe", "x" * 3000, ""]
    headers = {**served.headers, "x-file-name": quote(str(rng.choice(names)))}
    if rng.random() < 0.2:  # the upload breaks off
        head = "\r\n".join(f"{key}: {value}" for key, value in headers.items())
        sent = f"POST {upload_address()} HTTP/1.1\r\n{head}\r\nContent-Length: {len(data) + 9}\r\n\r\n".encode() + data
        return told(served.raw(sent))
    address = upload_address() if rng.random() < 0.8 else "/upload/guessed"
    return told(served.ask(address, "POST", headers=headers, content=data))


def odd(rng: np.random.Generator) -> object:
    """Return a value that no page sends."""
    return ODD[int(rng.integers(len(ODD)))]


def events(served: App, rng: np.random.Generator) -> str:
    """Send events of no page or another's, with invalid values, in any order."""
    listeners = re.findall(r"listener_id\W+([\w-]{36})", page())
    with opened(served) as link, suppress(WebSocketException, TimeoutError):
        link.send("40" + str(rng.choice(["", "", "", "/evil,", ",", "{}"])))
        for _ in range(int(rng.integers(1, 15))):
            name = str(rng.choice(EVENTS))
            given = {
                "client_id": _client_in(page()) if rng.random() < 0.7 else odd(rng),
                "id": int(rng.integers(0, 300)) if rng.random() < 0.8 else odd(rng),
                "listener_id": str(rng.choice(listeners)) if listeners and rng.random() < 0.8 else odd(rng),
                "args": [json.dumps(odd(rng)) for _ in range(int(rng.integers(0, 3)))],
                "tab_id": odd(rng), "document_id": odd(rng), "next_message_id": odd(rng), "level": odd(rng),
            }  # fmt: skip
            kept = {key: value for key, value in given.items() if rng.random() < 0.9}
            text = "42" + json.dumps([name, kept if rng.random() < 0.8 else odd(rng)])
            data = text.encode() if rng.random() < 0.8 else mutated(text.encode(), rng)
            link.send(data.decode("utf-8", "replace") if rng.random() < 0.9 else data)
    return ""


def crowds(served: App, rng: np.random.Generator) -> str:
    """Open many connections that send little or nothing."""
    with ExitStack() as stack:
        for _ in range(int(rng.integers(5, 100))):
            with suppress(OSError):
                link = stack.enter_context(
                    socket.create_connection(("127.0.0.1", served.server.port), timeout=PATIENCE_S)
                )
                link.sendall(b"GET / HTTP/1.1\r\nHost: x"[: int(rng.integers(0, 24))])
    return ""


CLASSES: dict[str, Damage] = {
    "malformed requests": attack(malformed),
    "paths out of the folders": attack(climbing),
    "uploads of anything": attack(uploads),
    "events of no page": attack(events),
    "crowds of connections": attack(crowds),
}
CAMPAIGN = Campaign("pages", "Hostile requests to the app", CLASSES)
