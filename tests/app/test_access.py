"""What the page asks of eyes and hands: words that are read, controls that Tab reaches, names, a focus that is seen."""

from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect
from tests.app.colour import GRAPHIC, TEXT, contrast, over
from tests.app.hands import Hands

from sightline.app.texts import STEPS
from sightline.planning.procedures.files import shipped

EYES, CONTROLS = (Path(__file__).with_name(name).read_text("utf-8") for name in ("eyes.js", "controls.js"))
pytestmark = pytest.mark.slow
LARGE_PX, LARGE_BOLD_PX = 24.0, 18.66  # 18 pt, 14 pt bold: WCAG 2.2, 1.4.3
SMALLEST_PX = 11.0  # on a screen of 1280 pixels [ours]


def written(page: Page) -> list[dict[str, Any]]:
    """Return all text on the page, once no animation is running."""
    page.wait_for_function("document.getAnimations().every(({ playState }) => playState === 'finished')")
    return page.evaluate(EYES)


def unread(words: list[dict[str, Any]]) -> list[str]:
    """What is written too small, or in too little contrast."""
    bad = []
    for word in words:
        large = word["size"] >= LARGE_PX or (word["bold"] and word["size"] >= LARGE_BOLD_PX)
        for image in ("rgb(0, 0, 0)", "rgb(255, 255, 255)"):
            grounds = [image if ground == "image" else ground for ground in word["grounds"]]
            below = over(*grounds)
            seen = word["opacity"] * over(word["colour"], *grounds) + (1.0 - word["opacity"]) * below
            ratio = contrast(seen, below)
            if ratio < (GRAPHIC if large else TEXT) or word["size"] < SMALLEST_PX:
                bad.append(f"{word['text']!r}: {ratio:.2f}:1, {word['size']:.0f} px, {word['colour']} on {grounds}")
    return bad


def test_words_are_read_on_every_step(hands: Hands) -> None:
    for step in STEPS:
        hands.step(step)
        hands.page.mouse.move(640, 795)
        expect(hands.page.get_by_role("tooltip")).to_have_count(0)
        if step == "plan":
            hands.press("space-toggle")
            hands.page.wait_for_function("window.sightlineSpace?.renders > 0")
        words = written(hands.page)
        assert len(words) > 15
        assert not unread(words), step
    hands.step("Plan")
    hands.see("kind").click()
    expect(hands.page.get_by_role("option")).to_have_count(len(shipped()))
    assert not unread(written(hands.page))
    hands.page.keyboard.press("Escape")
    hands.see("step-verify").hover()
    expect(hands.page.get_by_role("tooltip")).to_be_visible()
    assert not unread(written(hands.page))


def test_the_measure_finds_what_is_not_read() -> None:
    good = {
        "text": "a",
        "colour": "rgb(255, 255, 255)",
        "size": 15,
        "bold": False,
        "grounds": ["rgb(0, 0, 0)"],
        "opacity": 1,
    }
    assert not unread([good])
    for change in (
        {"colour": "rgb(80, 80, 80)"},
        {"size": 9},
        {"opacity": 0.3},
        {"grounds": ["rgba(0, 0, 0, 0.5)", "image"]},
    ):
        assert unread([good | change]), change


@pytest.mark.parametrize("step", ["Images", "Plan"])
def test_tab_reaches_every_control_which_has_a_name_and_shows_it(hands: Hands, step: str) -> None:
    hands.step(step)
    hands.press("space-toggle")
    expect(hands.page.get_by_test_id("space-fit-hip")).to_be_visible()
    wanted = {one["mark"]: one for one in hands.page.evaluate(CONTROLS, True)}
    assert len(wanted) > 14
    hands.page.mouse.click(3, 795)
    hands.page.evaluate("document.activeElement.blur()")
    reached: dict[str, dict[str, Any]] = {}
    for _ in range(2 * len(wanted)):
        hands.page.keyboard.press("Tab")
        at = hands.page.evaluate(CONTROLS, False)
        if at is not None and at["mark"] in reached:
            break
        if at is not None:
            reached[at["mark"]] = at
    missed = [one["what"] for mark, one in wanted.items() if mark not in reached]
    assert not missed
    assert not [one["what"] for one in reached.values() if not one["name"]]
    assert not [one["what"] for one in reached.values() if not one["seen"]]


def test_the_space_bar_presses_controls_while_there_is_no_robot_to_stop(hands: Hands) -> None:
    hands.step("Plan")
    hands.details()
    box = hands.see("show-beads")
    for checked in ("true", "false"):
        box.focus()
        hands.page.keyboard.press("Space")
        expect(box).to_have_attribute("aria-checked", checked)
