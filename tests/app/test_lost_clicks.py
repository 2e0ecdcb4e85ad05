"""A click whose button is built again between press and release, or before the program has the click, is not lost.

A program whose sections throw their buttons away loses the first by the browser's rule (the click goes to what press
and release have in common) and the second because the element that it names is gone.
"""

from collections.abc import Callable

import pytest
from playwright.sync_api import Locator, Page, expect
from tests.app.browser import Server
from tests.app.hands import PATIENCE_MS, Hands

pytestmark = pytest.mark.slow


def _press(hands: Hands, button: Locator) -> None:
    """Press the mouse on a button, and hold it."""
    expect(button).to_be_enabled()
    box = button.bounding_box()
    assert box is not None
    hands.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    hands.page.mouse.down()


def test_a_click_survives_a_section_that_is_built_again(
    server: Server, hands: Hands, open_page: Callable[..., Page]
) -> None:
    other = Hands(open_page(server.url))
    hands.step("Images")
    other.step("Images")
    left, right = hands.see("side-left"), hands.see("side-right")
    hands.press("side-right")
    expect(right).to_have_attribute("aria-checked", "true")  # the row has its width from here on
    element = right.get_attribute("id")
    _press(hands, right)
    other.press("side-left")
    expect(left).to_have_attribute("aria-checked", "true")  # another page has answered: the question is built again
    hands.page.mouse.up()
    expect(right).to_have_attribute("aria-checked", "true")
    assert right.get_attribute("id") == element  # the element that a click on its way names
    _press(hands, left)
    other.press("undo")
    expect(left).to_have_attribute("aria-checked", "true")
    other.press("redo")
    expect(right).to_have_attribute("aria-checked", "true")
    hands.page.mouse.move(5, 795)  # released elsewhere, it presses nothing
    hands.page.mouse.up()
    for _ in range(3):
        hands.press("undo")
    expect(right).to_have_attribute("aria-checked", "false")
    expect(left).to_have_attribute("aria-checked", "false")
    hands.step("Drill")
    expect(hands.see("verdict")).to_contain_text("patient's side")
    expect(hands.page.locator(".lead")).to_have_text("Back to Images")  # the plan comes first; fails where a robot does
    start = hands.see("start-robot")
    element = start.get_attribute("id")
    _press(hands, start)
    other.press("side-right")
    expect(hands.see("verdict")).not_to_contain_text("patient's side")
    assert start.get_attribute("id") == element
    hands.page.mouse.up()
    expect(hands.see("robot-state")).to_be_visible(timeout=PATIENCE_MS)
