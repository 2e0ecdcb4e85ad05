"""The whole procedure by keyboard alone, from two images to the check images.

A program with a control that Tab does not reach, a question that keys cannot answer, or a view that needs a pointer
ends the walk.
"""

from collections.abc import Callable

import numpy as np
import pytest
from playwright.sync_api import Page, expect
from tests.app.browser import Server
from tests.app.hands import KIND, PATIENCE_MS, SEED, Hands, truth

from sightline.app.plan.marks import marks_of
from sightline.case.views import NAMES

pytestmark = pytest.mark.slow
MAX_TABS = 200  # more than the page has controls
STEERED_PX = 1.0  # a fine step is an image pixel, half of one on the screen


@pytest.fixture(scope="module")
def server(serve: Callable[..., Server], tmp_path_factory: pytest.TempPathFactory) -> Server:
    command = ["sightline", "app", "--port", "{port}", "--no-browser", "--quiet", "--fast-robot"]
    return serve(*command, "--case", str(tmp_path_factory.mktemp("case")), "--rehearse", str(SEED))


def _tab_to(hands: Hands, selector: str) -> None:
    """Press Tab until a control has the focus."""
    control = hands.page.locator(selector).first
    expect(control).to_be_visible(timeout=PATIENCE_MS)
    expect(control).to_be_enabled(timeout=PATIENCE_MS)
    for _ in range(MAX_TABS):
        if hands.page.evaluate("selector => document.activeElement?.matches(selector)", selector):
            return
        hands.page.keyboard.press("Tab")
    raise AssertionError(f"Tab does not reach {selector}")


def _press(hands: Hands, testid: str) -> None:
    _tab_to(hands, f"[data-testid={testid}]")
    hands.page.keyboard.press("Enter")


def _place(hands: Hands, name: str, view: str, uv: tuple[float, float]) -> None:
    """Steer the cross-hair to a pixel and press Enter there. A point that slides stays on its curve."""
    hands.until(view, "core.state.placing === value", name)
    target = hands.on_screen(view, uv)
    _tab_to(hands, f"[data-testid=xray-{view}] [role=application]")
    keys, best = hands.page.keyboard, np.inf
    keys.press("ArrowRight")  # from the middle of the view
    expect(hands.page.locator(f"[data-testid=xray-{view}] [data-testid=live]")).not_to_be_empty()
    for _ in range(400):
        away = np.subtract(target, hands.core(view, "core.toScreen(core.crosshair.uv)"))
        across = int(np.argmax(np.abs(away)))
        if np.abs(away[across]) < STEERED_PX or np.hypot(*away) >= best:
            break
        fine = np.abs(away[across]) < 10.0
        best = np.inf if not fine else float(np.hypot(*away))
        arrow = (("ArrowLeft", "ArrowRight"), ("ArrowUp", "ArrowDown"))[across][int(away[across] > 0.0)]
        keys.press(f"Shift+{arrow}" if fine else arrow)
    assert hands.core(view, "core.lens !== null")  # the magnifier is where the cross-hair is
    keys.press("Enter")
    hands.until(view, "core.state.placing !== value", name)


def test_the_whole_procedure_by_keyboard_alone(server: Server, open_page: Callable[..., Page]) -> None:
    hands = Hands(open_page(server.url))
    keys = hands.page.keyboard
    hands.wait_for_step("Calibrate", "done")
    _tab_to(hands, "[role=radio]")
    keys.press("ArrowRight")
    expect(hands.see("side-left")).to_have_attribute("aria-checked", "true")
    _tab_to(hands, "[data-testid=side-left]")
    keys.press("ArrowLeft")
    expect(hands.see("side-right")).to_have_attribute("aria-checked", "true")
    _tab_to(hands, "input[data-testid=serial], [data-testid=serial] input")
    keys.type("none")
    keys.press("Enter")
    hands.wait_for_step("Images", "done")
    _press(hands, "step-plan")
    known = truth()
    landmarks = [one.name for one in marks_of(KIND) if one.group == "landmark"]
    asked = [(name, view) for view in NAMES for name in ("entry", "end")]
    for name, view in asked + [(name, view) for name in landmarks for view in NAMES]:
        _place(hands, name, view, known[name][view])
    _press(hands, "place-head")
    for view in NAMES:
        for name in sorted(name for name in known if name.startswith("head-")):
            _place(hands, name, view, known[name][view])
    expect(hands.see("figures")).to_contain_text("(95 %)")
    expect(hands.see("verdict").locator(".verdict-word")).to_have_text("GO")
    _press(hands, "continue")
    _press(hands, "start-robot")
    for order in ("send", "align", "drill", "drill-on"):
        _press(hands, order)
        _press(hands, f"{order}-yes")
        expect(hands.see(f"{order}-yes")).to_have_count(0)
    expect(hands.see("drilled")).to_be_visible(timeout=PATIENCE_MS)
    _press(hands, "step-verify")
    _press(hands, "take-check")
    for view in NAMES:
        hands.until(view, "core.state.layers.get('found')?.shapes.length > 0")
    _press(hands, "details")
    expect(hands.see("check-checks")).to_be_visible()
