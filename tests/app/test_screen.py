"""The page on screens of four sizes: no overlap, nothing cut, planning never scrolls."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect
from tests.app.browser import Server
from tests.app.hands import PATIENCE_MS, Hands

from sightline.app.panels.top import size_of
from sightline.app.texts import STEPS
from sightline.planning.procedures.files import shipped

GEOMETRY = Path(__file__).with_name("geometry.js").read_text("utf-8")
SIZES = ((1280, 800), (1920, 1080), (1024, 768), (800, 1280))
LONG = (  # the longest sentence of a check that a person meets while planning
    "The gaps of 3 free points together are 2.3 times what picks and views explain; the picks are less accurate than "
    "stated, or the patient moved: pick all points again, or state a larger error of the picks, which increases the "
    "plan's own error."
)
PLANNED_AT = (1280, 800)  # from this size on the column does not scroll on the step Plan
pytestmark = pytest.mark.slow


def wrong(page: Page, *, scrolls: bool) -> list[str]:
    """What is wrong with the page's geometry, once it has come to rest."""
    page.wait_for_function("document.getAnimations().every(({ playState }) => playState === 'finished')")
    return page.evaluate(GEOMETRY, scrolls)


def _say(page: Page, sentence: str) -> None:
    """Put a sentence into the row of the instruction, as the page writes it."""
    page.locator("[data-testid=instruction]").evaluate(
        "(line, [text, size]) => { line.className = `instruction ${size}`; line.textContent = text; }",
        [sentence, size_of(sentence)],
    )


def _rest(page: Page) -> None:
    """Move the pointer where it shows no tooltip."""
    page.mouse.move(5, page.viewport_size["height"] - 5)  # type: ignore[index]
    expect(page.get_by_role("tooltip")).to_have_count(0)


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_every_step_fits_every_screen(
    server: Server, open_page: Callable[..., Page], size: tuple[int, int], shoot
) -> None:
    page = open_page(server.url)
    hands = Hands(page)
    expect(page.locator("html")).to_have_attribute("lang", "en-US")
    expect(hands.see("step-calibrate")).to_have_class(re.compile("done"), timeout=PATIENCE_MS)
    page.set_viewport_size({"width": size[0], "height": size[1]})
    for step in STEPS:
        hands.step(step)
        _rest(page)
        assert not wrong(page, scrolls=step != "plan"), step
        if step == "plan":
            _say(page, LONG)
            assert not wrong(page, scrolls=False), LONG
        shoot(page, f"{step}-{size[0]}")
    pa, lateral = (hands.core(name, "core.root.getBoundingClientRect().toJSON()") for name in ("pa", "lateral"))
    if size[0] < size[1]:
        assert pa["bottom"] <= lateral["top"] and pa["left"] == lateral["left"]  # stacked
    else:
        assert pa["right"] <= lateral["left"] and pa["top"] == lateral["top"]


def test_the_checklist_of_every_procedure_fits(server: Server, open_page: Callable[..., Page]) -> None:
    page = open_page(server.url)
    hands = Hands(page)
    expect(hands.see("step-calibrate")).to_have_class(re.compile("done"), timeout=PATIENCE_MS)
    page.set_viewport_size({"width": PLANNED_AT[0], "height": PLANNED_AT[1]})
    hands.step("Plan")
    column = page.locator(".panel").bounding_box()
    assert column is not None and 290 <= column["width"] <= 310
    for number in range(len(shipped())):
        hands.see("kind").click()
        option = page.get_by_role("option").nth(number)
        name = option.inner_text()
        option.click()
        expect(hands.see("kind")).to_contain_text(name)
        _rest(page)
        assert not wrong(page, scrolls=False), name


def test_the_measure_finds_what_does_not_fit(hands: Hands) -> None:
    page = hands.page
    hands.step("Plan")
    hands.see("kind").click()
    page.get_by_role("option").first.click()  # whose bone the patient has: then an image shows a hint
    hands.until("pa", "Boolean(core.state.placing)")
    _rest(page)
    assert not wrong(page, scrolls=False)
    for style, found in (
        (".stop-box { translate: 99em }", "off the screen"),
        (".say { width: 3em }", "cut"),
        (".xray-tools.xray-tools { max-width: 16em }", "tools in"),
        (".xray .xray-hint { translate: 0 9em }", "the hint"),
        (".figure-grid { translate: 0 3em }", "overlap"),
        (".kind .q-field__native { translate: 0 0.6em }", "on its line"),
        (".xray .xray-foot .xray-panel { max-width: 4em }", "cut"),
        (".checklist { min-height: 99em }", "scrolls"),
    ):
        added = page.add_style_tag(content=style)
        assert any(found in line for line in wrong(page, scrolls=False)), style
        added.evaluate("element => element.remove()")
