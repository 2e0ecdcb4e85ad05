"""Drag a point of an X-ray view in an installed Chromium, and rows of what was measured."""

import asyncio
from collections.abc import Sequence
from typing import Any

import numpy as np
from playwright.async_api import Page

from benchmarks.rows import Row

FRAME_MS = 1000 / 60
REQUIRED_FRAME_MS = 1.05 * FRAME_MS  # a frame that was not missed, and 5 % for the clock


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
