"""How many pages the program builds and keeps at once."""

import asyncio
from typing import Any

from sightline.app.web.serve import MAX_PAGES, MAX_WAITING, Pages

OTHERS = ("/image/", "/_nicegui")


class _App:
    """Builds pages that wait until they are let go; counts those that are built at the same time."""

    def __init__(self) -> None:
        self.go_on = asyncio.Event()
        self.built = self.at_once = self.most = 0

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "http" and not scope["path"].startswith(OTHERS):
            self.at_once += 1
            self.most = max(self.most, self.at_once)
            await self.go_on.wait()
            self.at_once -= 1
            self.built += 1
        await send({"type": "http.response.start", "status": 200, "headers": []})


async def _status(pages: Pages, path: str = "/", kind: str = "http") -> int:
    sent: list[Any] = []

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {"type": kind, "method": "GET", "path": path}
    await pages(scope, lambda: asyncio.sleep(0), send)  # pyright: ignore[reportArgumentType]
    return sent[0]["status"]


def test_two_hundred_page_loads_at_once_build_a_few_and_hold_nothing_else_up() -> None:
    async def flood() -> None:
        app = _App()
        pages = Pages(app, OTHERS, lambda: 0)
        loads = [asyncio.create_task(_status(pages, f"/{n}")) for n in range(200)]
        await asyncio.sleep(0)
        refused = [one for one in loads if one.done()]
        assert len(refused) == 200 - 1 - MAX_WAITING  # refused at once, without waiting
        assert {one.result() for one in refused} == {503}
        assert await _status(pages, "/image/a.u16") == 200
        assert await _status(pages, kind="websocket") == 200
        app.go_on.set()
        assert sorted(await asyncio.gather(*loads)) == [200] * (1 + MAX_WAITING) + [503] * len(refused)
        assert (app.built, app.most) == (1 + MAX_WAITING, 1)
        assert await _status(pages) == 200  # and then the next

    asyncio.run(flood())


def test_pages_that_are_open_are_counted() -> None:
    async def one_more(there: int) -> int:
        app = _App()
        app.go_on.set()
        return await _status(Pages(app, OTHERS, lambda: there))

    assert asyncio.run(one_more(MAX_PAGES - 1)) == 200
    assert asyncio.run(one_more(MAX_PAGES)) == 503
