"""HTML of a section in the browser: set anew, but for the elements that were there before."""

from collections.abc import Iterator
from itertools import permutations
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page

from sightline.app.panels import section

SCRIPT = Path(section.__file__).with_name("html_section.js").read_text("utf-8")
# Sets the first HTML, then the second; returns what is shown, and whether the first element is the same one.
SHOW = """async ([source, first, second, anew = false]) => {
  const { default: { methods } } = await import("data:text/javascript," + encodeURIComponent(source));
  const section = { $el: document.createElement("section") };
  methods.show.call(section, first);
  const before = section.$el.firstElementChild;
  methods.show.call(section, second, anew);
  return [section.$el.innerHTML, before !== null && before === section.$el.firstElementChild];
}"""
FIGURE = '<div class="figure {}"><b>{}</b><i style="width: {}%;"></i></div>'
HTML = (
    "",
    FIGURE.format("passed", "0.41 mm", 40),
    FIGURE.format("failed", "1.20 mm", 95),
    '<div class="figure open" lang="de">–<!-- none --></div>',
    "<p>no wire: a &lt; b</p>",
    '<div><div lang="en">GO</div></div><p>two</p>',
)


@pytest.fixture(scope="module")
def page(browser: Browser) -> Iterator[Page]:
    """An empty page."""
    page = browser.new_page()
    yield page
    page.close()


def test_what_is_shown_is_the_newest_html(page: Page) -> None:
    """Catches a text, an attribute or an element of the HTML before that stays, or a new one that is left out."""
    for first, second in permutations(HTML, 2):
        assert page.evaluate(SHOW, [SCRIPT, first, second])[0] == second


def test_elements_stay_where_only_texts_and_attributes_differ(page: Page) -> None:
    """Catches elements built anew by each message of a drag, which the browser lays out anew."""
    assert page.evaluate(SHOW, [SCRIPT, HTML[1], HTML[2]])[1]
    assert not page.evaluate(SHOW, [SCRIPT, HTML[1], HTML[4]])[1]


def test_a_notice_that_is_repeated_is_built_anew(page: Page) -> None:
    """A screen reader announces what is put into a live region: fails where a second, identical notice changes
    nothing."""
    assert page.evaluate(SHOW, [SCRIPT, HTML[4], HTML[4], True]) == [HTML[4], False]
