"""The page in the eyes of axe-core (MPL-2.0): nothing serious or moderate on any step."""

from collections.abc import Callable
from importlib.resources import files

import pytest
from playwright.sync_api import Page, expect
from tests.app.browser import Server
from tests.app.hands import Hands

from sightline.app.texts import STEPS

pytestmark = pytest.mark.slow
_WRONG = {"moderate", "serious", "critical"}


def found(page: Page) -> dict[str, str]:
    """Return what axe-core finds wrong by the names of its rules: elements and what to do."""
    page.mouse.move(640, 795)
    expect(page.get_by_role("tooltip")).to_have_count(0)
    return {
        one["id"]: "; ".join(f"{node['html'][:200]}: {node['failureSummary']}" for node in one["nodes"])
        for one in page.evaluate("axe.run()")["violations"]
        if one["impact"] in _WRONG
    }


def test_axe_finds_nothing_on_any_step(server: Server, open_page: Callable[..., Page]) -> None:
    hands = Hands(open_page(server.url))
    hands.wait_for_step("Calibrate", "done")
    hands.page.evaluate((files("axe_playwright_python") / "axe.min.js").read_text("utf-8"))
    for step in STEPS:
        hands.step(step)
        assert found(hands.page) == {}, step
        hands.details()
        assert found(hands.page) == {}, f"{step}, the drawer open"
        hands.details()
    hands.page.evaluate("document.querySelector('[data-testid=details]').textContent = ''")
    assert "button-name" in found(hands.page)  # it does look
