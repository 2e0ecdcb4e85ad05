"""Limits the pages built and open at once: building one blocks the event loop for most of a second."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

from starlette.responses import PlainTextResponse

from sightline.app.web.guard import App, Receive, Scope, Send

MAX_WAITING = 3  # [ours] pages that wait while one is built: seconds on a slow machine
MAX_PAGES = 32  # [ours] open pages, as many as sockets (guard.MAX_SOCKETS)
RETRY_S = 5  # [ours]
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
            await PlainTextResponse(_TOO_MANY, 503, {"Retry-After": str(RETRY_S)})(scope, receive, send)
        else:
            self._waiting += 1
            try:
                async with self._one:
                    await self.app(scope, receive, send)
            finally:
                self._waiting -= 1
