"""The guard in front of the app: access control by host, origin and token, and limits on size and number of requests.

Pure ASGI, because Starlette's middleware classes do not see WebSockets. Threats: docs/app-security.md.
"""

import asyncio
import hashlib
import hmac
import ipaddress
import re
import secrets
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import parse_qs

from sightline.errors import UnusableInputError

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

MIN_TOKEN_CHARACTERS = 16  # 96 bits of base64; OWASP asks 64 of a session identifier
MAX_BODY_BYTES = 1_000_000  # Socket.IO's own limit on a message; no other body is expected
MAX_SOCKETS = 32  # [ours] a page holds one, and a second one while it reconnects
BODY_PAUSE_S = 30.0  # [ours] longest silence within a body: a slow network pauses for longer than a page reloads

_LOOPBACK_NAMES = {"localhost", "127.0.0.1", "::1"}
_HOST = re.compile(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+)(?::(\d{1,5}))?")


@dataclass
class Guard:
    """An ASGI app in front of `app`, served at `host`:`port`. `token`: None requires none.

    `body_limits` maps a path prefix to its largest body in bytes; elsewhere MAX_BODY_BYTES holds. Raises
    UnusableInputError for a short token, or without one if other machines can reach the app.
    """

    app: App
    host: str
    port: int
    token: str | None = None
    body_limits: Mapping[str, int] = field(default_factory=dict)
    _sockets: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        if self.token is None and not is_loopback(self.host):
            raise UnusableInputError(f"{self.host} can be reached by others, so a token is needed; give one")
        if self.token is not None and len(self.token) < MIN_TOKEN_CHARACTERS:
            raise UnusableInputError(f"the token has fewer than {MIN_TOKEN_CHARACTERS} characters; give a longer one")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection: forward it with limits, or refuse it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
        elif scope["type"] == "websocket":
            await self._socket(scope, receive, send)
        else:
            await self._request(scope, receive, send)

    async def _request(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = _Headers(scope)
        nonce = secrets.token_urlsafe(16)
        send = _Secured(send, nonce, headers.get("host"))
        refusal = self._refusal(scope, headers)
        if refusal is None and scope["method"] not in ("GET", "HEAD", "POST"):
            refusal = _OwnResponse(405, "this app accepts only GET, HEAD and POST")
        if refusal is None and self.token is not None:
            if scope["method"] == "GET" and _query_token(scope) is not None:
                await self._enter(scope, send)
                return
            refusal = self._token_refusal(headers)
        if refusal is not None:
            await refusal.send(send)
            return
        await self._pass_on(_without_proxy_headers(scope), receive, send, headers)

    async def _pass_on(self, scope: Scope, receive: Receive, send: Send, headers: "_Headers") -> None:
        limit = next((n for start, n in self.body_limits.items() if scope["path"].startswith(start)), MAX_BODY_BYTES)
        body = _Body(receive, limit)
        held = _Held(send, body)
        try:
            if headers.length() > limit:
                body.refusal = _too_large(limit)
            else:
                await self.app(scope, body.receive, held.send)
        except Exception:
            if body.refusal is None:
                raise
        if body.refusal is not None and not held.started:
            await body.refusal.send(send)

    async def _socket(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = _Headers(scope)
        refused = self._refusal(scope, headers) or (self.token is not None and self._token_refusal(headers))
        if refused or self._sockets >= MAX_SOCKETS:
            await receive()
            await send({"type": "websocket.close", "code": 1008})  # before it is accepted: the server answers 403
            return
        self._sockets += 1
        try:
            await self.app(_without_proxy_headers(scope), receive, send)
        finally:
            self._sockets -= 1

    def _refusal(self, scope: Scope, headers: "_Headers") -> "_OwnResponse | None":
        """Return a refusal unless Host is where the connection arrived and Origin is our own; a foreign page can set
        neither."""
        if not self._is_our_host(headers.get("host"), scope.get("server")):
            return _OwnResponse(421, "open the address that the terminal shows: this app has another name")
        origins = headers.all("origin")
        must_have_one = scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD")
        if (must_have_one and not origins) or any(o != f"http://{headers.get('host')}" for o in origins):
            return _OwnResponse(403, "reload the page: the request does not come from this app's own page")
        # A foreign page can still request a picture or a script without an Origin; browsers then state this header.
        if headers.get("sec-fetch-site") in ("cross-site", "same-site") and headers.get("sec-fetch-mode") != "navigate":
            return _OwnResponse(403, "open this app's own page: the request comes from another page")
        return None

    def _is_our_host(self, host: str | None, arrived_at: Any) -> bool:
        match = _HOST.fullmatch(host or "")
        if match is None or int(match[2] or 80) != self.port:
            return False
        name, address = match[1].strip("[]").lower(), arrived_at[0] if arrived_at else self.host
        if name in _LOOPBACK_NAMES:
            return is_loopback(address)
        return name == address or (name == self.host.lower() and not _is_wildcard(name))

    def _token_refusal(self, headers: "_Headers") -> "_OwnResponse | None":
        if _same(headers.cookie(self._cookie_name), self._cookie):
            return None
        return _OwnResponse(
            401, "open the address that the terminal shows (if you just did, reload): a token is needed"
        )

    async def _enter(self, scope: Scope, send: Send) -> None:
        """Exchange the token in the address for a cookie, and redirect to the address without it."""
        answer = _OwnResponse(401, "open the address that the terminal shows: the token is wrong")
        if _same(_query_token(scope), self.token):
            cookie = f"{self._cookie_name}={self._cookie}; Path=/; HttpOnly; SameSite=Strict"
            answer = _OwnResponse(303, "", [(b"location", b"/"), (b"set-cookie", cookie.encode())])
        await answer.send(send)

    @property
    def _cookie_name(self) -> str:
        return f"sightline-{self.port}"  # cookies do not distinguish ports

    @property
    def _cookie(self) -> str:
        return hashlib.sha256((self.token or "").encode()).hexdigest()  # valid in a cookie for any token


def is_loopback(host: str) -> bool:
    """Return whether only this machine can connect to the address or name `host`."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _is_wildcard(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return False


def _same(given: str | None, expected: str | None) -> bool:
    """Return whether two texts are equal and not empty, in constant time."""
    return hmac.compare_digest((given or "").encode(), (expected or "").encode()) and bool(expected)


def _query_token(scope: Scope) -> str | None:
    query = parse_qs(scope["query_string"].decode("latin-1"), keep_blank_values=True)
    return query["token"][0] if "token" in query else None


def _without_proxy_headers(scope: Scope) -> Scope:
    """Return the scope without X-Forwarded headers: NiceGUI writes them into its page, and no proxy is expected."""
    return {**scope, "headers": [(k, v) for k, v in scope["headers"] if not k.startswith(b"x-forwarded-")]}


class _Headers:
    """Request headers as text; `get` treats a repeated header as absent."""

    def __init__(self, scope: Scope) -> None:
        self._pairs = [(k.decode("latin-1").lower(), v.decode("latin-1")) for k, v in scope["headers"]]

    def all(self, name: str) -> list[str]:
        return [value for key, value in self._pairs if key == name]

    def get(self, name: str) -> str | None:
        values = self.all(name)
        return values[0] if len(values) == 1 else None

    def length(self) -> int:
        value = self.get("content-length") or "0"
        return int(value) if value.isascii() and value.isdigit() else 0

    def cookie(self, name: str) -> str | None:
        pairs = (part.strip().partition("=") for line in self.all("cookie") for part in line.split(";"))
        return next((value for key, _, value in pairs if key == name), None)


@dataclass(frozen=True)
class _OwnResponse:
    """A response by the guard itself, mostly a refusal."""

    status: int
    sentence: str
    headers: list[tuple[bytes, bytes]] = field(default_factory=list)

    async def send(self, send: Send) -> None:
        body = self.sentence.encode()
        headers = [
            (b"content-type", b"text/plain; charset=utf-8"),
            (b"content-length", str(len(body)).encode()),
            (b"cache-control", b"no-store"),
            *self.headers,
        ]
        await send({"type": "http.response.start", "status": self.status, "headers": headers})
        await send({"type": "http.response.body", "body": body})


def _too_large(limit: int) -> _OwnResponse:
    return _OwnResponse(413, f"send less at once: the limit is {limit / 1e6:.0f} MB")


class _Body:
    """A request's body with limits: on its size as it arrives, whatever its Content-Length says, and on pauses."""

    def __init__(self, receive: Receive, limit: int) -> None:
        self._receive, self._limit = receive, limit
        self._left, self._whole = limit, False
        self.refusal: _OwnResponse | None = None

    async def receive(self) -> Message:
        if self._whole:
            return await self._receive()  # waits for a disconnect while the app answers
        try:
            message = await asyncio.wait_for(self._receive(), BODY_PAUSE_S)
        except TimeoutError:
            self.refusal = _OwnResponse(408, "send the request again: the rest of it did not arrive")
            return {"type": "http.disconnect"}
        if message["type"] == "http.request":
            self._left -= len(message.get("body", b""))
            self._whole = not message.get("more_body", False)
        if self._left < 0:
            self.refusal = _too_large(self._limit)
            return {"type": "http.disconnect"}
        return message


class _Held:
    """The app's response, suppressed once the guard sends its own."""

    def __init__(self, send: Send, body: _Body) -> None:
        self._send, self._body = send, body
        self.started = False

    async def send(self, message: Message) -> None:
        if self._body.refusal is None or self.started:
            self.started = True
            await self._send(message)


class _Secured:
    """Adds the security headers to a response, and to a page's own scripts the nonce that allows them to run."""

    def __init__(self, send: Send, nonce: str, host: str | None) -> None:
        self._send, self._nonce, self._host = send, nonce, host
        self._page: Message | None = None  # the start of an HTML response, until its length is known
        self._html = bytearray()

    async def __call__(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            own = {name for name, _ in self._headers()}
            headers = [(k, v) for k, v in message.get("headers", []) if k.lower() not in own] + self._headers()
            message = {**message, "headers": headers}
            if dict(headers).get(b"content-type", b"").startswith(b"text/html"):
                self._page = message
                return
        elif self._page is not None:
            self._html += message.get("body", b"")
            if not message.get("more_body", False):
                await self._send_page(self._page, bytes(self._html))
            return
        await self._send(message)

    async def _send_page(self, start: Message, html: bytes) -> None:
        # All external text is escaped in the page, so each "<script" here is the page's own.
        html = html.replace(b"<script", f'<script nonce="{self._nonce}"'.encode())
        headers = [(k, v) for k, v in start["headers"] if k.lower() != b"content-length"]
        await self._send({**start, "headers": [*headers, (b"content-length", str(len(html)).encode())]})
        await self._send({"type": "http.response.body", "body": html})

    def _headers(self) -> list[tuple[bytes, bytes]]:
        sockets = f" ws://{self._host}" if _HOST.fullmatch(self._host or "") else ""  # older Safari: not in 'self'
        policy = (
            "default-src 'self'; "
            f"script-src 'self' 'nonce-{self._nonce}' 'unsafe-eval'; "  # Vue compiles its templates in the browser
            "style-src 'self' 'unsafe-inline'; "  # Vue and Quasar set styles on elements
            "img-src 'self' data: blob:; font-src 'self' data:; "
            f"connect-src 'self'{sockets}; "
            "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
        )
        return [
            (b"content-security-policy", policy.encode()),
            (b"x-content-type-options", b"nosniff"),
            (b"referrer-policy", b"no-referrer"),
            (b"cross-origin-opener-policy", b"same-origin"),
            (b"cross-origin-resource-policy", b"same-origin"),
        ]
