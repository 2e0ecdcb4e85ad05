"""The X-ray view in an installed Chromium: frames while dragging a point, repaints of the window.

Two views of 1024 x 1024 with 120 beads; the pointer moves at 60 Hz; the server computes for 15 ms on each move. Times
are measured in the page, from the pointer event's time stamp to the end of the frame that draws it.
"""

import asyncio
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from playwright.async_api import Page, async_playwright
from tests.app.browser import FLAGS, Server, find_chromium
from tests.app.xray_page import POINTS

from benchmarks.rows import Row

COMPUTING_S = 0.015
FRAME_MS = 1000 / 60
REQUIRED_FRAME_MS = 1.05 * FRAME_MS  # a frame that was not missed, and 5 % for the clock

# Records the run time of each frame's code, and when each pointer move is drawn.
_WATCH = """() => {
  const watch = (window.watch = { frame: [], point: [] });
  const request = window.requestAnimationFrame;
  let undrawn = null;
  window.addEventListener("pointermove", (event) => { undrawn = event.timeStamp; }, true);
  window.requestAnimationFrame = (draw) => request((now) => {
    const start = performance.now();
    draw(now);
    watch.frame.push(performance.now() - start);
    if (undrawn !== null) watch.point.push(performance.now() - undrawn);
    undrawn = null;
  });
}"""

_REPAINT = """async (times) => {
  const core = window.sightlineXray.pa;
  window.watch.frame = [];
  for (let index = 0; index < times; index++) {
    core.settings.setWindow({ centre: 20000 + 100 * (index % 50), width: 30000 });
    await new Promise((done) => requestAnimationFrame(done));
  }
  return window.watch.frame.filter((ms) => ms > 0.2); // without those of this loop, that draw nothing
}"""


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    group = "X-ray view"
    path = find_chromium()
    if path is None:
        return [Row(group, "no Chromium is installed", "-")]
    with tempfile.TemporaryDirectory() as folder:
        server = Server(Path(folder) / "log.txt", "tests.app.xray_page", "{port}", str(COMPUTING_S), "1")
        try:
            seen, frames, repaints = asyncio.run(_measure(path, server.url, 60 if quick else 600))
        finally:
            server.stop()
    drawn = high(seen["point"])
    return [
        frame_row(group, frames),
        Row(group, "pointer to the point drawn", spread(seen["point"]), "one frame", met=drawn <= FRAME_MS),
        Row(group, "code of a frame in a drag", spread(seen["frame"])),
        Row(group, "repaint of another window", spread(repaints), "one frame", met=high(repaints) <= FRAME_MS),
    ]


async def _measure(path: str, url: str, times: int) -> tuple[dict[str, list[float]], list[float], list[float]]:
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=path, args=FLAGS)
        page = await browser.new_page(viewport={"width": 1280, "height": 800})
        await page.goto(url)
        await page.wait_for_function(
            "window.sightlineXray?.pa?.state.image && window.sightlineXray.lateral?.state.image"
        )
        await page.request.post(f"{url}do/beads", params={"mark": 1})
        await page.wait_for_function("window.marked === 1")
        await page.evaluate(_WATCH)
        frames = await drag(page, POINTS[0]["uv"], times)
        seen = await page.evaluate("window.watch")
        repaints = await page.evaluate(_REPAINT, times)
        await browser.close()
    return seen, frames, repaints


async def drag(page: Page, uv: Sequence[float], moves: int, reach: float = 60.0) -> list[float]:
    """Drag the point at `uv` of the PA view for `moves` of 1/60 s; return the intervals of the frames, ms."""
    x, y = await page.evaluate("uv => window.sightlineXray.pa.toScreen(uv)", list(uv))
    hand = await page.context.new_cdp_session(page)

    def do(kind: str, dx: float, dy: float) -> "asyncio.Task[Any]":
        event = {"type": kind, "x": x + dx, "y": y + dy, "button": "left", "buttons": 1, "clickCount": 1}
        return asyncio.ensure_future(hand.send("Input.dispatchMouseEvent", event))

    await do("mousePressed", 0, 0)
    await page.evaluate("window.sightlineXray.pa.canvas.frames.length = 0")
    clock = asyncio.get_running_loop()
    started = clock.time()
    under_way = []
    for index in range(moves):  # without waiting for the previous one, as a hand does
        under_way.append(do("mouseMoved", reach * np.sin(index / 15), reach * np.sin(index / 23)))
        await asyncio.sleep(max(started + (index + 1) / 60 - clock.time(), 0.0))
    await asyncio.gather(*under_way)
    frames = await page.evaluate("window.sightlineXray.pa.canvas.frames")
    await do("mouseReleased", 0, 0)
    return frames


def high(values: list[float]) -> float:
    """Return the 95th percentile."""
    return float(np.percentile(values, 95))


def frame_row(group: str, frames: list[float]) -> Row:
    """Return the row of the frame intervals of a drag."""
    required, met = f"{FRAME_MS:.1f} ms at 95 %", high(frames) <= REQUIRED_FRAME_MS
    return Row(group, "interval of frames in a drag", spread(frames), required, met=met)


def spread(values: list[float]) -> str:
    """Return median and 95th percentile of times, ms, as text."""
    return f"{np.median(values):.1f} ms, 95 % {high(values):.1f} ms"
