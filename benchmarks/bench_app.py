"""The app in an installed Chromium: times of its start, delays while dragging, and what a move costs the server.

A simulated patient, two views of 1024 x 1024, a complete plan (wire, landmarks, the head's outline). The tip is dragged
in the PA image at 60 Hz for 5 s. Times are measured in the page, from the pointer event's time stamp to the end of the
frame that draws it. Of four starts the first, which compiles the modules, does not count.
"""

import asyncio
import os
import socket
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from playwright.async_api import async_playwright
from playwright.sync_api import Browser, Page
from tests.app.browser import FLAGS, Server, chromium, find_chromium
from tests.app.hands import SEED, Hands

from benchmarks.dragging import FRAME_MS, drag, high
from benchmarks.rows import Row

GROUP = "app"
REQUIRED_PAGE_S = 3.0
REQUIRED_DRAWN_S = 8.0  # on a busy machine
REQUIRED_MS = {  # median, 95 %
    "curve": ("pointer to the lateral curve", 16.7, 33.0),
    "figures": ("pointer to the figures", 50.0, 80.0),
    "frames": ("interval of frames in a drag", 16.7, 20.0),
}
REQUIRED_CPU_MS = 10.0
LONG_MS = 20.0  # of a frame: one that was missed
CLOCK = 1.05  # a frame that was not missed may take so much longer by the browser's clock
REACH_PX = 40.0  # of the drag, on the screen
SECONDS = 5
LOADS = 200
PATIENCE_MS = 120_000

# Each move's curve is looked for in the frame that draws the move; of moves within one frame the last is drawn. Metrics
# belong to the move whose point they come with.
_WATCH = """() => {
  const watch = (window.watch = { curve: [], figures: [], moves: 0, came: [], drawn: [] });
  const { pa, lateral } = window.sightlineXray;
  const [request, push, show] = [window.requestAnimationFrame, pa.edits.moves.push, pa.show];
  const times = new Map();
  let pointer = 0;
  let shown = null;
  let curve = null;
  window.addEventListener("pointermove", (event) => { pointer = event.timeStamp; watch.moves++; }, true);
  window.addEventListener("pointerrawupdate", (event) => {
    pointer = event.timeStamp;
    watch.came.push(pointer);
  }, true);
  const { canvas } = pa;
  canvas.frames.push = (since) => {
    watch.drawn.push([canvas.lastFrame, since]);
    return Array.prototype.push.call(canvas.frames, since);
  };
  const after = (then) => request(() => setTimeout(then));
  pa.edits.moves.push = (type, id, uv, image) => {
    times.set(String(uv), pointer);
    after(() => {
      const drawn = lateral.matching.drawn.get(id);
      const of = drawn && drawn.curve ? String(drawn.uv) : curve;
      if (of !== curve) watch.curve.push(performance.now() - times.get(of));
      curve = of;
    });
    return push.call(pa.edits.moves, type, id, uv, image);
  };
  pa.show = (word) => {
    const end = word.points?.find(({ id }) => id === "end");
    shown = (end && times.get(String(end.uv))) ?? null;
    return show.call(pa, word);
  };
  new MutationObserver(() => {
    const from = shown;
    if (from !== null) after(() => watch.figures.push(performance.now() - from));
    shown = null;
  }).observe(document.querySelector("section.figures"), { childList: true, subtree: true, characterData: true });
}"""


class _Server(Server):
    """A server that is up once it accepts a connection, so that the timed page is the first one built."""

    @property
    def cpu_s(self) -> float:
        """CPU time of its process so far, s."""
        assert self._process is not None
        times = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(times[11]) + int(times[12])) / os.sysconf("SC_CLK_TCK")

    def _answers(self) -> bool:
        try:
            socket.create_connection(("127.0.0.1", self.port), timeout=1.0).close()
        except OSError:
            return False
        return True


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    path = find_chromium()
    if path is None:
        return [Row(GROUP, "no Chromium is installed", "-")]
    busy = f"{os.getloadavg()[0]:.1f}"
    starts = []
    server: _Server | None = None
    try:
        with tempfile.TemporaryDirectory() as folder:
            with _installed(Path(folder)), chromium(path) as browser:
                server, page, _ = _start(browser, Path(tempfile.mkdtemp(dir=folder)))  # compiles the modules
                for _ in range(1 if quick else 3):
                    server.stop()
                    server, page, seconds = _start(browser, Path(tempfile.mkdtemp(dir=folder)))
                    starts.append(seconds)
                _plan(page)
            loads = _flood(server.url)
            seen = asyncio.run(_measure(path, server, 60 * SECONDS))
            server.stop()
            server.check()
    finally:
        if server is not None:
            server.stop()
    first, drawn, calibrated = np.median(starts, axis=0)
    return [
        _start_row(f"start to the first page, load {busy}", first, REQUIRED_PAGE_S),
        _start_row("start to both images on the screen", drawn, REQUIRED_DRAWN_S),
        Row(GROUP, "start to both images calibrated", f"{calibrated:.1f} s"),
        *loads,
        *_drag_rows(seen),
    ]


@contextmanager
def _installed(folder: Path) -> Generator[None]:
    """Let Python keep compiled modules, in `folder`, as those of an installed program are; a machine's settings, or a
    checkout, may have none."""
    before = dict(os.environ)
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = str(folder / "modules")
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def _start_row(what: str, seconds: float, required: float) -> Row:
    return Row(GROUP, what, f"{seconds:.1f} s", f"{required:.0f} s", met=bool(seconds < required))


def _drag_rows(seen: dict[str, Any]) -> list[Row]:
    """Return the rows of a drag: median and 95 % of each delay, and the server's CPU time for each set of figures."""
    rows = []
    for key, (what, median, most) in REQUIRED_MS.items():
        found = float(np.median(seen[key])), high(seen[key])
        met = found[0] <= CLOCK * median and found[1] <= most
        value, required = (f"{a:.1f} / {b:.1f} ms" for a, b in (found, (median, most)))
        rows.append(
            Row(GROUP, f"{what}, median / 95 %, {len(seen[key])} of {seen['moves']} moves", value, required, met=met)
        )
    frames, long, late = _long_frames(np.array(seen["drawn"]), np.array(seen["came"]))
    what = f"frames longer than {LONG_MS:.0f} ms, and those of them with no move to draw in time"
    rows.append(Row(GROUP, what, f"{long} of {frames}; {late}"))
    each = seen["cpu_ms"] / max(len(seen["figures"]), 1)
    what = f"CPU of the server a move, {len(seen['figures'])} computed"
    return [*rows, Row(GROUP, what, f"{each:.0f} ms", f"{REQUIRED_CPU_MS:.0f} ms", met=each < REQUIRED_CPU_MS)]


def _long_frames(drawn_ms: np.ndarray, came_ms: np.ndarray) -> tuple[int, int, int]:
    """Return how many frames, (N, 2) time and interval, there were while moves came, (M,); how many took longer than
    LONG_MS; and before how many of these no move came within a period of the frame before: the pointer was late, so
    that there was nothing to draw."""
    drawn = drawn_ms[(drawn_ms[:, 0] - drawn_ms[:, 1] > came_ms.min()) & (drawn_ms[:, 0] < came_ms.max())]
    long = drawn[drawn[:, 1] > LONG_MS]
    before = (long[:, 0] - long[:, 1])[:, None]
    came = (came_ms > before) & (came_ms <= before + FRAME_MS)
    return len(drawn), len(long), int((~came.any(axis=1)).sum())


def _start(browser: Browser, folder: Path) -> tuple[_Server, Page, tuple[float, float, float]]:
    """Return server and page of the app on a new case, and s until its steps are shown, both images on the screen, and
    both views calibrated."""
    command = ["sightline", "app", "--port", "{port}", "--no-browser", "--quiet"]
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    began = time.perf_counter()
    server = _Server(folder / "log.txt", *command, "--case", str(folder / "case"), "--rehearse", str(SEED))
    page.goto(server.url, timeout=PATIENCE_MS)
    page.get_by_test_id("step-images").wait_for(timeout=PATIENCE_MS)
    seen = time.perf_counter() - began
    both = "['pa', 'lateral'].every((name) => window.sightlineXray?.[name]?.state.image)"
    page.wait_for_function(both, timeout=PATIENCE_MS)
    drawn = time.perf_counter() - began
    Hands(page).wait_for_step("Calibrate", "done")
    return server, page, (seen, drawn, time.perf_counter() - began)


def _plan(page: Page) -> None:
    """Make a complete plan by mouse."""
    hands = Hands(page)
    hands.confirm()
    hands.plan()


def _flood(url: str) -> list[Row]:
    """Measure simultaneous page loads: built ones, those asked to retry, and their times."""

    def load(_: int) -> tuple[int, float]:
        began = time.perf_counter()
        try:
            with urllib.request.urlopen(url, timeout=PATIENCE_MS / 1000) as answer:  # noqa: S310
                answer.read()
                status = answer.status
        except urllib.error.HTTPError as refused:
            status = refused.code
        except OSError:  # more connections than the server takes
            status = 0
        return status, time.perf_counter() - began

    with ThreadPoolExecutor(LOADS) as pool:
        found = list(pool.map(load, range(LOADS)))
    built, others = ([seconds for status, seconds in found if (status == 200) is there] for there in (True, False))
    after = load(0)[1]
    what = f"{LOADS} page loads at once: {len(built)} built, {len(others)} told to come again"
    seconds = f"all built after {max(built, default=0.0):.1f} s; refused within {max(others, default=0.0):.1f} s"
    return [Row(GROUP, what, seconds), Row(GROUP, "the next page load after them", f"{after:.1f} s")]


async def _measure(path: str, server: _Server, times: int) -> dict[str, Any]:
    """Return what `_WATCH` sees in a drag, the intervals of frames, and the server's CPU time, ms."""
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=path, args=FLAGS)
        page = await browser.new_page(viewport={"width": 1280, "height": 800})
        await page.goto(server.url)
        await page.get_by_test_id("step-plan").click()
        await page.get_by_test_id("figures").wait_for()
        await page.wait_for_function("window.sightlineXray.lateral.state.layers.get('curves')?.shapes.length")
        await page.wait_for_function("window.sightlineXray.lateral.matching.sights")
        await page.wait_for_timeout(1000)  # until the page has come to rest
        await page.evaluate(_WATCH)
        start = await page.evaluate("window.sightlineXray.pa.state.points.get('end').uv")
        before = server.cpu_s
        frames = await drag(page, start, times, REACH_PX)
        spent = server.cpu_s - before
        seen = await page.evaluate("window.watch")
        await browser.close()
    return {**seen, "frames": frames, "cpu_ms": 1000.0 * spent}
