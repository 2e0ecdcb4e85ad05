"""Fingers on the real page, as of a tablet without a mouse.

A program whose controls wait for hovering, whose pinch zooms the page instead of the image, or whose drag scrolls the
page instead of moving the point fails here.
"""

from collections.abc import Callable

import numpy as np
import pytest
from playwright.sync_api import Page, expect
from tests.app.browser import Server
from tests.app.hands import Hands, truth

pytestmark = pytest.mark.slow
Place = tuple[float, float]
REACHED_PX = 3.0  # of the image: a finger is lifted at a whole pixel of the screen, the image drawn at 0.45


def _stroke(page: Page, *path: list[Place]) -> None:
    """Put fingers on the glass, move them, and lift them."""
    session = page.context.new_cdp_session(page)
    for kind, places in zip(("touchStart", *["touchMove"] * (len(path) - 1), "touchEnd"), (*path, []), strict=True):
        touches = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(places)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})


def test_fingers_place_drag_and_pinch(server: Server, open_page: Callable[..., Page]) -> None:
    page = open_page(server.url, has_touch=True, is_mobile=True)
    hands = Hands(page)
    hands.wait_for_step("Calibrate", "done")
    for view in ("pa", "lateral"):
        for part in (".xray-tools", ".xray-foot"):
            expect(page.get_by_test_id(f"xray-{view}").locator(part)).to_have_css("opacity", "1")
    hands.see("step-plan").tap()
    expect(hands.see("step-plan")).to_have_attribute("aria-current", "step")
    for name in ("entry", "end"):  # then the page asks in the other image, and fingers in this one move points
        hands.until("pa", "core.state.placing === value", name)
        _stroke(page, [hands.on_screen("pa", truth()[name]["pa"])])
        hands.until("pa", "core.state.points.get(value)?.uv && !core.edits.moved.size", name)
    hands.until("pa", "core.state.placing === null")
    before = hands.placed("entry", "pa")
    assert np.hypot(*np.subtract(before, truth()["entry"]["pa"])) < REACHED_PX
    x, y = hands.on_screen("pa", before)
    _stroke(page, [(x, y)], [(x + 10, y)], [(x + 10, y - 30)], [(x + 40, y - 30)])
    hands.until("pa", "core.state.points.get('entry').uv[0] !== value && !core.edits.moved.size", before[0])
    moved = np.subtract(hands.on_screen("pa", hands.placed("entry", "pa")), (x, y))
    assert np.all(np.abs(moved - [30.0, -30.0]) < 12.0)  # from where the touch became a drag
    at, zoom = hands.on_screen("lateral", truth()["end"]["lateral"]), hands.core("lateral", "core.display.zoom")
    (x, y), (a, b) = at, (40.0, 80.0)
    _stroke(page, [(x - a, y), (x + a, y)], [(x - b, y), (x + b, y)])
    hands.until("lateral", "Math.abs(core.display.zoom / value - 2) < 0.01", zoom)
    assert page.evaluate("visualViewport.scale") == 1
    assert page.evaluate("[scrollX, scrollY]") == [0, 0]
