"""A person who knows only the screen: reads its words and presses buttons."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from playwright.sync_api import Page, expect
from tests.app.hands import PATIENCE_MS, Pixels

# "3 of 10 · LATERAL · Entry point: slide along its curve and click"
_ORDER = re.compile(r"^(\d+) of (\d+) · (PA|LATERAL|INLET|OUTLET)(?: CHECK)? · ([^:]+): ")
_LINES = "document.body.innerText.split('\\n')"
_ASKED = f"([order, before]) => {_LINES}.find(line => new RegExp(order).test(line) && line !== before)"
_GONE = f"said => !{_LINES}.includes(said)"
_VIEWS = {"PA": "pa", "LATERAL": "lateral", "INLET": "pa", "OUTLET": "lateral"}
_ASKS = ("Send the plan", "Align", "Drill", "Continue drilling")  # before these a person is asked again
# The button in the lower right corner, as [words, whether it can be pressed]; ["", false] where none stands there.
_LAST = """() => {
  const last = document.elementFromPoint(innerWidth - 40, innerHeight - 32)?.closest('button');
  return last ? [last.innerText, !last.disabled] : ['', false];
}"""
_OTHER = (
    f"([before, until]) => {{ const [words, on] = ({_LAST})(); return words === until || (on && words !== before); }}"
)


class Place(Protocol):
    """Where an image is shown."""

    def at(self, uv: tuple[float, float]) -> tuple[float, float]:
        """Return where a pixel is on the screen."""
        ...


class Person:
    """Before a page. `know` first, then `place` what the page asks for."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self._shown: dict[str, Place] = {}

    def press(self, words: str) -> None:
        """What shows these words: the last of them on the page, where a question stands."""
        self.page.get_by_text(words, exact=True).locator("visible=true").last.click()

    def type(self, label: str, text: str) -> None:
        """Into the field with this label."""
        self.page.get_by_label(label).fill(text)

    def choose(self, label: str, words: str) -> None:
        """The option that says so, of the choice with this label."""
        self.page.get_by_role("combobox", name=label).click()
        self.page.get_by_role("option", name=words, exact=True).click()

    def load(self, words: str | re.Pattern[str], file: Path) -> None:
        """Choose a file for the place that says so."""
        place = self.page.locator(".drop-in").filter(has_text=words)
        with self.page.expect_file_chooser() as asked:
            place.get_by_text("Choose a file", exact=True).click()
        asked.value.set_files(file)
        expect(place).to_have_count(0, timeout=PATIENCE_MS)

    def read(self, words: str | re.Pattern[str]) -> None:
        """Wait until the page says so."""
        expect(self.page.get_by_text(words).first).to_be_visible(timeout=PATIENCE_MS)

    def know(self, shown: Mapping[str, Place]) -> None:
        """Be told where each view shows its image."""
        self._shown.update(shown)

    def place(self, known: Mapping[str, Pixels]) -> int:
        """Click what the page asks for, wherever `known` has it by its name on the page, until it was the last; return
        how many clicks."""
        clicks, said = 0, ""
        while True:
            said = self._next_order(said)
            asked = _ORDER.match(said)
            assert asked is not None, said
            number, count, view, name = asked.groups()
            self.page.mouse.click(*self._shown[_VIEWS[view]].at(known[name][_VIEWS[view]]))
            clicks += 1
            if number == count:
                self.page.wait_for_function(_GONE, arg=said)
                return clicks
            assert clicks < 50, f"the page asks for {name} again and again"

    def _next_order(self, before: str) -> str:
        """What the page asks for, once it is not what it asked for before."""
        found = self.page.wait_for_function(_ASKED, arg=[_ORDER.pattern, before]).json_value()
        return str(found)

    def go_on(self, until: str) -> list[str]:
        """Press the button at the lower right, and yes where it asks, until that says `until`; return the words."""
        pressed = [""]
        while True:
            self.page.wait_for_function(_OTHER, arg=[pressed[-1], until], timeout=PATIENCE_MS)
            words = str(self.page.evaluate(_LAST)[0])
            if words == until:
                return pressed[1:]
            assert len(pressed) < 20, pressed
            self.press(words)
            pressed.append(words)
            self._answer(words)

    def _answer(self, words: str) -> None:
        """Say yes, beside Cancel, where the button moves the arm or tells it a plan."""
        if words in _ASKS:
            self.page.get_by_role("dialog").get_by_role("button", name=words, exact=True).click()
