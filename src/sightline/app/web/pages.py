"""How many pages are built and kept at once: each takes the program's one thread for most of a second."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

from starlette.responses import PlainTextResponse

from sightline.app.web.guard import App, Receive, Scope, Send

MAX_WAITING = 3  # [ours] pages that wait for the one that is built: seconds on a slow machine
MAX_PAGES = 32  # [ours] that are open, as many as there may be sockets (guard.MAX_SOCKETS)
RETRY_S = 5  # [ours]
_TOO_MANY = "too many pages are being opened; close some, and reload this one in a few seconds"


@dataclass
class Pages:
    """An ASGI app in front of `app`: pages are built one after another, and refused where too many wait or are open.

    A page is what a GET asks for outside `others`, starts of paths. `open_pages`: how many there are."""

    app: App
    others: tuple[str, ...]
    open_pages: Callable[[], int]
    _one: asyncio.Lock = field(default_factory=asyncio.Lock, init=False)
    _asked: int = field(default=0, init=False)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One connection: passed on in its turn, or refused."""
        if scope["type"] != "http" or scope["method"] == "POST" or scope["path"].startswith(self.others):
            await self.app(scope, receive, send)
        elif self._asked > MAX_WAITING or self.open_pages() >= MAX_PAGES:
            await PlainTextResponse(_TOO_MANY, 503, {"Retry-After": str(RETRY_S)})(scope, receive, send)
        else:
            self._asked += 1
            try:
                async with self._one:
                    await self.app(scope, receive, send)
            finally:
                self._asked -= 1
