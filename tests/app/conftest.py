"""Fixtures of the app's browser tests; without an installed Chromium they skip, and where CI=true they fail."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Locator, Page
from tests.app.browser import ROOT, Server, Tab, chromium, find_chromium

from sightline.app.session.jobs import WorkerProcess


# For each file, not for the session: the synchronous Playwright holds an event loop in this thread, and tests of other
# rooms in the same process run their own.
@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """An installed Chromium, headless."""
    path = find_chromium()
    if path is None:
        said = "no browser: install Chromium (Debian: apt-get install chromium), or name one in the variable CHROME"
        if os.environ.get("CI") == "true":
            pytest.fail(said)
        pytest.skip(said)
    with chromium(path) as found:
        yield found


@pytest.fixture(scope="module")
def serve(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Server]]:
    """`serve(*argv)` runs `python -m *argv` with "{port}" filled in until the file's tests are done."""
    servers: list[Server] = []

    def start(*argv: str, **options: Path) -> Server:
        servers.append(Server(tmp_path_factory.mktemp("server") / "log.txt", *argv, **options))
        return servers[-1]

    yield start
    for server in servers:
        server.stop()
    for server in servers:
        server.check()


@pytest.fixture
def open_page(browser: Browser) -> Iterator[Callable[..., Page]]:
    """`open_page(url, allow=(...), **context options)`: a page; requests off this machine and errors fail the test."""
    opened: list[tuple[Tab, tuple[str, ...]]] = []

    def open_(url: str, *, allow: tuple[str, ...] = (), **options: Any) -> Page:
        tab = Tab(browser, url, **options)
        opened.append((tab, allow))
        return tab.page

    yield open_
    for tab, _ in opened:
        tab.close()
    for tab, allow in opened:
        tab.check(allow)


@pytest.fixture(scope="module")
def worker() -> Iterator[WorkerProcess]:
    made = WorkerProcess()
    yield made
    made.close()


@pytest.fixture(scope="session")
def shoot() -> Callable[[Page | Locator, str], None]:
    """`shoot(page or locator, name)` keeps a screenshot: out/app/NAME.png."""
    folder = ROOT / "out" / "app"

    def take(what: Page | Locator, name: str) -> None:
        what.screenshot(path=folder / f"{name}.png")

    return take
