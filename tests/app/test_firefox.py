"""One whole walk in an installed Firefox: buttons and states by the words that a person reads."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.app import NO_BROWSER
from tests.app.bidi import NAMES as FIREFOXES
from tests.app.bidi import Firefox, find_firefox, firefox
from tests.app.browser import Server
from tests.app.hands import KIND, SEED, truth

from sightline.app import texts
from sightline.app.plan.marks import marks_of
from sightline.case.views import NAMES

pytestmark = pytest.mark.slow
_CONTROL, _ENTER = "\ue009", "\ue007"
_QUESTION = "[role=dialog]"
# The middle of the last button of this text within some part of the page that is enabled, not covered, and at rest: a
# question grows when it opens, and two looks within one frame of that find the button at one place, which it leaves.
_BUTTON = """((text, part) => {
  const moves = (element) => element && (element.getAnimations().length || moves(element.parentElement));
  for (const button of [...document.querySelectorAll("button, label, [role=radio]")].reverse()) {
    if (!button.closest(part)) continue;
    if (button.innerText.trim() !== text || button.disabled || moves(button)) continue;
    const { left, top, width, height } = button.getBoundingClientRect();
    const middle = [left + width / 2, top + height / 2];
    if (width && button.contains(document.elementFromPoint(...middle))) return middle;
  }
})"""


def _press(page: Firefox, text: str, part: str = "body") -> None:
    """Press a button once it rests."""
    found, before = f"{_BUTTON}({json.dumps(text)}, {json.dumps(part)})", None
    while (at := page.until(found)) != before:
        before = at
    page.click(*at)


def _see(page: Firefox, text: str) -> None:
    page.until(f"document.body.innerText.includes({json.dumps(text)})")


def _agree(page: Firefox, text: str) -> None:
    """Press a button, once no question is open, and again in its question."""
    page.until(f"!document.querySelector('{_QUESTION}')")
    _press(page, text)
    _press(page, text, _QUESTION)


def _place(page: Firefox, name: str, view: str) -> None:
    core = f"sightlineXray.{view}"
    page.until(f"{core}.state.placing === {json.dumps(name)}")
    page.click(*page.ask(f"{core}.toScreen({json.dumps(truth()[name][view])})"))
    page.until(f"{core}.state.placing !== {json.dumps(name)}")


def _plan(page: Firefox) -> None:
    landmarks = [one.name for one in marks_of(KIND) if one.group == "landmark"]
    asked = [(name, view) for view in NAMES for name in ("entry", "end")]
    for name, view in asked + [(name, view) for name in landmarks for view in NAMES]:
        _place(page, name, view)
    page.ask("document.querySelector('[data-testid=place-head]').click()")  # its word is that of its neighbours
    for view in NAMES:
        for name in sorted(name for name in truth() if name.startswith("head-")):
            _place(page, name, view)


def _drag_and_undo(page: Firefox) -> None:
    end, verdict = "sightlineXray.pa.state.points.get('end').uv", "document.querySelector('.figures').innerText"
    before, shown = page.ask(end), page.ask(verdict)
    x, y = page.ask(f"sightlineXray.pa.toScreen({end})")
    page.drag((x, y), (x - 8, y + 4), (x - 16, y + 8))
    page.until(f"{end}[0] < {before[0] - 10}")
    page.until(f"{verdict} !== {json.dumps(shown)}")
    page.type("z", held=_CONTROL)
    page.until(f"{end}[0] === {before[0]}")
    page.until(f"{verdict} === {json.dumps(shown)}")


def test_a_whole_walk_in_firefox(serve: Callable[..., Server], tmp_path: Path) -> None:
    path = find_firefox()
    if path is None:
        said = f"{NO_BROWSER}: none of {', '.join(FIREFOXES)} is installed"
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(said)
    (tmp_path / "profile").mkdir()
    command = ["sightline", "app", "--port", "{port}", "--no-browser", "--quiet", "--fast-robot"]
    server = serve(*command, "--case", str(tmp_path / "case"), "--rehearse", str(SEED))
    with firefox(path, tmp_path / "profile") as page:
        page.open(server.url)
        page.until(
            "document.body.innerText.replace(/\\s+/g, ' ').includes('2 Calibrate done')"
        )  # it is connected by then
        _press(page, "Right side")
        field = "document.querySelector('input[data-testid=serial], [data-testid=serial] input')"
        page.until(f"{field} && ({field}.focus(), document.activeElement === {field})")
        page.type("none" + _ENTER)
        _press(page, texts.SERIAL_CONFIRM)
        for step in ("calibrate", "plan"):
            _press(page, texts.CONTINUE_TO.format(step=texts.STEPS[step]))
        _plan(page)
        page.until("document.querySelector('.verdict-word').innerText === 'GO'")
        _drag_and_undo(page)
        _press(page, texts.CONTINUE_TO.format(step=texts.STEPS["drill"]))
        _press(page, texts.START_ROBOT)
        for order in (texts.SEND, texts.ALIGN, texts.DRILL, texts.DRILL_ON):
            _agree(page, order)
        _see(page, texts.STATES["DONE"])
        _press(page, texts.CONTINUE_TO.format(step=texts.STEPS["verify"]))
        _press(page, texts.TAKE_CHECK)
        for view in NAMES:
            page.until(f"sightlineXray.{view}.state.layers.get('found')?.shapes.length")
        assert not [error for error in page.errors if "WebGL" not in error]
