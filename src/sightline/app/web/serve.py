"""Serves the page: NiceGUI behind the guard, on a server in this process, until it is stopped."""

import asyncio
import secrets
import signal
import socket
import threading
import webbrowser
from collections.abc import Awaitable, Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field

import uvicorn
from fastapi import FastAPI
from nicegui import Client, core, ui
from starlette.responses import PlainTextResponse
from uvicorn.protocols.http.h11_impl import H11Protocol

from sightline.app.web.guard import MAX_BODY_BYTES, MAX_SOCKETS, App, Guard, Receive, Scope, Send, is_loopback
from sightline.app.web.transfers import IMAGES_PATH, MAX_UPLOAD_BYTES, UPLOADS_PATH, Images, Uploads
from sightline.errors import UnusableInputError

MAX_WAITING = 3  # [ours] pages that wait while one is built: seconds on a slow machine
MAX_PAGES = MAX_SOCKETS  # open pages, each with a socket
_TOO_MANY = "close some pages and reload this one in a few seconds: too many are being opened"


@dataclass
class Pages:
    """An ASGI app in front of `app`: pages are built one after another, and refused if too many wait or are open.

    Every GET outside the path prefixes `others` is a page. `open_pages`: returns the number of open pages."""

    app: App
    others: tuple[str, ...]
    open_pages: Callable[[], int]
    _one: asyncio.Lock = field(default_factory=asyncio.Lock, init=False)
    _waiting: int = field(default=0, init=False)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection: forward it in its turn, or refuse it."""
        if scope["type"] != "http" or scope["method"] == "POST" or scope["path"].startswith(self.others):
            await self.app(scope, receive, send)
        elif self._waiting > MAX_WAITING or self.open_pages() >= MAX_PAGES:
            await PlainTextResponse(_TOO_MANY, 503, {"Retry-After": str(int(_PATIENCE_S))})(scope, receive, send)
        else:
            self._waiting += 1
            try:
                async with self._one:
                    await self.app(scope, receive, send)
            finally:
                self._waiting -= 1


MAX_CONNECTIONS = 2 * MAX_SOCKETS  # [calc] sockets, and as many requests for files
_PATIENCE_S = 10.0  # [ours] a browser that is silent for longer has gone: one that reloads is back in a second
STOP_S = 3  # [ours] time limit for open connections to finish: longer, a person presses Ctrl+C again
_NO_PAGES = ("/_nicegui", "/favicon", IMAGES_PATH, UPLOADS_PATH)

_ICON = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 32 32" fill="none" stroke="#56b4e9" stroke-width="3">'
    '<circle cx="16" cy="16" r="10"/><path d="M16 1v10M16 21v10M1 16h10M21 16h10"/></svg>'
)


@dataclass
class ServedApp:
    """The running app: its address, and the images and uploads that pages use."""

    host: str
    port: int
    token: str | None
    images: Images = field(default_factory=Images)
    uploads: Uploads = field(default_factory=Uploads)
    stop: Callable[[], None] = lambda: None

    @property
    def url(self) -> str:
        """The address to open in a browser, with the token if there is one."""
        address = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.host, self.host)  # noqa: S104
        name = f"[{address}]" if ":" in address else address
        return f"http://{name}:{self.port}/" + (f"?token={self.token}" if self.token else "")

    @property
    def reachable_from_outside(self) -> bool:
        """Whether other machines can connect."""
        return not is_loopback(self.host)


PageRoot = Callable[[ServedApp], Awaitable[None] | None]


def serve(
    page_root: PageRoot,
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    token: str | None = None,
    open_browser: bool = False,
    on_ready: Callable[[ServedApp], None] = lambda site: None,
) -> None:
    """Serve the page that `page_root` builds, until Ctrl-C, SIGTERM or `ServedApp.stop`; once per process.

    Port 0 chooses a free one. Beyond the loopback addresses a token is required; one is made if none is given. Raises
    UnusableInputError for an address or port that cannot be opened, or a short token.
    """
    if token is None and not is_loopback(host):
        token = secrets.token_urlsafe(24)
    with _listen(host, port) as listener:
        site = ServedApp(host, listener.getsockname()[1], token)
        server = _Server(guarded(page_root, site), lambda: _ready(site, open_browser, on_ready))
        site.stop = server.stop
        with _sigterm_is_no_error():
            server.run(sockets=[listener])


def guarded(page_root: PageRoot, site: ServedApp) -> Guard:
    """Return the whole app behind its guard: page, static files, sockets, images and uploads."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    app.router.routes += [site.images.route, site.uploads.route]
    ui.run_with(
        app,
        root=lambda: page_root(site),
        title="Sightline",
        favicon=_ICON,
        dark=True,
        language="en-US",
        reconnect_timeout=_PATIENCE_S,
        gzip_middleware_factory=None,  # compression is slower than the loopback
        tailwind=False,  # saves 270 kB of compiler per page
        show_welcome_message=False,
    )
    core.app.config.quasar_config["loadingBar"]["skipHijack"] = True  # no bar over the page at each download
    core.sio.on("alive", _alive)
    core.sio.eio.cors_allowed_origins = []  # send no header that admits other pages; the guard checks Origin
    core.sio.eio.max_http_buffer_size = MAX_BODY_BYTES
    pages = Pages(app, _NO_PAGES, lambda: len(Client.instances))
    return Guard(pages, site.host, site.port, site.token, {UPLOADS_PATH: MAX_UPLOAD_BYTES})


async def _alive(_: str) -> bool:
    """Answer a page's probe whether the program is alive (page.js)."""
    return True


def _ready(site: ServedApp, open_browser: bool, on_ready: Callable[[ServedApp], None]) -> None:
    on_ready(site)
    if open_browser:
        threading.Thread(target=webbrowser.open, args=[site.url], daemon=True).start()


@contextmanager
def _listen(host: str, port: int) -> Generator[socket.socket]:
    if not 0 <= port <= 65535:
        raise UnusableInputError(f"{port} is not a port; give one from 0 to 65535, 0 for any free one")
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        listener = socket.create_server(address[:2], family=family)
    except OSError as error:
        raise UnusableInputError(
            f"cannot serve at {host} port {port} ({error.strerror}); another program may be using it: "
            "give another --port, or 0 for any free one"
        ) from error
    with listener:
        yield listener


class _Server(uvicorn.Server):
    """Uvicorn with limits per client, and a callback when it has started."""

    def __init__(self, app: Guard, on_started: Callable[[], None]) -> None:
        self._on_started = on_started
        super().__init__(
            uvicorn.Config(
                app,  # pyright: ignore[reportArgumentType]  # its own ASGI types are typed dicts
                http=_Http,
                ws="websockets-sansio",
                ws_max_size=MAX_BODY_BYTES,
                ws_per_message_deflate=False,
                limit_concurrency=MAX_CONNECTIONS,
                timeout_graceful_shutdown=STOP_S,
                proxy_headers=False,
                server_header=False,
                access_log=False,  # no names in logs
                log_config=None,
                log_level="warning",
            )
        )

    def stop(self) -> None:
        """End `run`. Any thread may call it."""
        self.should_exit = True

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, and call `on_started`."""
        await super().startup(sockets)
        if self.started:
            self._on_started()


class _Http(H11Protocol):
    """HTTP with a time limit on a request's headers. (h11 also limits them to 64 KiB.)"""

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A client has connected."""
        super().connection_made(transport)
        self._await_headers()

    def on_response_complete(self) -> None:
        """A response was sent; the next request may come."""
        super().on_response_complete()
        self._await_headers()

    def connection_lost(self, exc: Exception | None) -> None:
        """The client has disconnected."""
        self._forget_deadline()
        super().connection_lost(exc)

    def handle_websocket_upgrade(self, event) -> None:
        """The connection becomes a WebSocket, which has its own timeouts."""
        self._forget_deadline()
        super().handle_websocket_upgrade(event)

    def _await_headers(self) -> None:
        self._forget_deadline()
        self._deadline = self.loop.call_later(_PATIENCE_S, self._close_if_none_came)

    def _forget_deadline(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()

    def _close_if_none_came(self) -> None:
        if self.cycle is None or self.cycle.response_complete:
            self.transport.close()


@contextmanager
def _sigterm_is_no_error() -> Generator[None]:
    """Ignore the signal that Uvicorn raises again after an orderly shutdown: it is not an error."""
    if threading.current_thread() is not threading.main_thread():  # Python allows signal handlers only there
        yield
        return
    before = signal.signal(signal.SIGTERM, lambda *_: None)
    try:
        yield
    except KeyboardInterrupt:
        pass
    finally:
        signal.signal(signal.SIGTERM, before)
