"""What the app's browser tests share: an installed Chromium, servers in processes of their own, watched pages."""

import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from weakref import WeakKeyDictionary

from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, expect, sync_playwright

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = [
    *("--disable-gpu", "--disable-quic", "--no-first-run", "--no-proxy-server"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1, EXCLUDE localhost",  # nothing else can be reached
]
START_S = 300.0  # a server that has not answered by then never will, on a busy machine either
END_S = 20.0
PATIENCE_MS = 120_000  # of a page, for what a test waits for


def find_chromium() -> str | None:
    """Path of an installed Chromium or Chrome: what CHROME names, or the first of `NAMES` there is."""
    named = os.environ.get("CHROME")
    return next((path for name in ([named] if named else NAMES) if (path := shutil.which(name))), None)


@contextmanager
def chromium(path: str) -> Iterator[Browser]:
    """The browser at `path`, headless, that reaches nothing but this machine."""
    expect.set_options(timeout=PATIENCE_MS)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        try:
            yield browser
        finally:
            browser.close()


class Server:
    """`python -m *argv` in a separate process, with "{port}" filled in."""

    def __init__(self, log: Path, *argv: str, cwd: Path = ROOT) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port: int = free.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}/"
        self.log, self.cwd = log, cwd
        self.argv = [argument.replace("{port}", str(self.port)) for argument in argv]
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    def start(self) -> None:
        """Start it (again, on the same port) and wait until it answers."""
        environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTEST_", "NICEGUI_"))}
        environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        with self.log.open("ab") as log:
            command = [sys.executable, "-m", *self.argv]
            self._process = subprocess.Popen(command, stdout=log, stderr=log, cwd=self.cwd, env=environment)  # noqa: S603
        last = time.monotonic() + START_S
        while not self._answers():
            if self._process.poll() is not None or time.monotonic() > last:
                self.stop()
                raise RuntimeError(f"the server did not start:\n{self.log.read_text()}")
            time.sleep(0.05)

    def _answers(self) -> bool:
        try:
            with urllib.request.urlopen(self.url, timeout=START_S):  # noqa: S310
                return True
        except urllib.error.HTTPError:
            return True  # it answers, if only to refuse
        except OSError:
            return False

    def terminate(self) -> int:
        """Ask it to end, and return how it ended."""
        assert self._process is not None
        self._process.terminate()
        return self._process.wait(END_S)

    def stop(self) -> None:
        """End it: terminate first, then kill."""
        if self._process is None:
            return
        try:
            self.terminate()
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process = None

    def check(self) -> None:
        """Fail if the server had an unhandled error."""
        assert "Traceback" not in self.log.read_text(), self.log.read_text()


_CONTEXTS: WeakKeyDictionary[Browser, dict[str, BrowserContext]] = WeakKeyDictionary()


class Tab:
    """A page whose requests off this machine and whose errors on the console are remembered."""

    def __init__(self, browser: Browser, url: str, **options: Any) -> None:
        self.strays: list[str] = []
        self.errors: list[str] = []
        contexts = _CONTEXTS.setdefault(browser, {})  # pages of the same options share one cache
        if repr(options) not in contexts:
            given = {"viewport": {"width": 1280, "height": 800}, "reduced_motion": "reduce", **options}
            contexts[repr(options)] = browser.new_context(**given)
        self.page: Page = contexts[repr(options)].new_page()
        self.page.on("request", lambda request: self._asked(request.url))
        self.page.set_default_timeout(PATIENCE_MS)
        self.page.on("websocket", lambda opened: self._asked(opened.url))
        self.page.on("console", self._said)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(url)

    def _asked(self, url: str) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("data", "blob", "about") and parts.hostname not in ("127.0.0.1", "localhost"):
            self.strays.append(url)

    def _said(self, message: ConsoleMessage) -> None:
        if message.type == "error":
            self.errors.append(message.text)

    def check(self, allow: tuple[str, ...] = ()) -> None:
        """Fail on requests off this machine and on errors that hold none of `allow`; then forget them."""
        unexpected = [error for error in self.errors if not any(part in error for part in allow)]
        strays = list(self.strays)
        self.errors.clear()
        self.strays.clear()
        assert not strays, f"requests off this machine: {strays}"
        assert not unexpected, f"errors in the browser: {unexpected}"

    def close(self) -> None:
        self.page.close()


def stroke(page: Page, *path: list[tuple[float, float]]) -> None:
    """Put fingers on the glass, move them, and lift them."""
    session = page.context.new_cdp_session(page)
    for kind, places in zip(("touchStart", *["touchMove"] * (len(path) - 1), "touchEnd"), (*path, []), strict=True):
        touches = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(places)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})
