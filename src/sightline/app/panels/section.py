"""Parts of the page that are redrawn only when their content changes."""

from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup
from nicegui import ui

from sightline.app.drawing.calls import Calling
from sightline.app.panels import markup
from sightline.app.session.failures import failure_of
from sightline.app.tab.tab import Tab
from sightline.checks import Check

Key = Callable[[Tab], Hashable]


class _Part:
    """A part of the page that is filled, and filled again whenever `key(tab)` changes. If that fails, it shows the
    error and the other parts of the page continue."""

    def __init__(self, tab: Tab, key: Key, box: ui.element) -> None:
        self._tab, self._key, self._box = tab, key, box
        self._shown: Hashable = object()
        tab.on_refresh.append(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        """Fill it if its key has changed."""
        if self._box.is_deleted:
            for called in (self._tab.on_refresh, self._tab.on_drag):
                called[:] = [one for one in called if one != self.refresh]
            return
        found: list[Hashable] = []
        refused = failure_of(lambda: found.append(self._key(self._tab)))
        key = (refused, *found)
        if key != self._shown:
            self._shown = key
            self._fill(refused)

    def _fill(self, refused: str) -> None:
        raise NotImplementedError


class Section(_Part):
    """A part that `build(tab)` fills with elements. Sections may contain sections, so that rebuilding one does not lose
    text typed into another."""

    def __init__(self, tab: Tab, key: Key, build: Callable[[Tab], None], *, classes: str = "") -> None:
        self._build = build
        super().__init__(tab, key, ui.element("section").classes(classes))

    def _fill(self, refused: str) -> None:
        self._box.clear()
        with self._box:
            refused = refused or failure_of(lambda: self._build(self._tab))
            if refused:
                self._box.clear()  # half a section could mislead
                note(refused, kind="bad", testid="section-refused")


class PersistentSection(_Part):
    """A part that `build(tab)` fills once; it returns the function that updates it. Its buttons persist during a
    refresh, so that clicks are not lost."""

    def __init__(self, tab: Tab, key: Key, build: Callable[[Tab], Callable[[], None]], *, classes: str = "") -> None:
        with ui.element("section").classes(classes) as box:
            self._update = build(tab)
        super().__init__(tab, key, box)

    def _fill(self, refused: str) -> None:
        self._tab.message = refused or failure_of(self._update) or self._tab.message


class HtmlSection(_Part):
    """A part that `html(tab)` fills with HTML: fast enough to follow a drag, which the other parts do not."""

    def __init__(self, tab: Tab, key: Key, html: Callable[[Tab], Markup], *, classes: str = "") -> None:
        self._html, self._element = html, _Html()
        tab.on_drag.append(self.refresh)
        super().__init__(tab, key, self._element.classes(classes))

    def _fill(self, refused: str) -> None:
        made: list[Markup] = []
        refused = refused or failure_of(lambda: made.append(self._html(self._tab)))
        self._element.show(markup.note(refused, kind="bad", testid="section-refused") if refused else made[0])


class _Html(Calling, component=Path(__file__).parent / "html_section.js"):
    def __init__(self) -> None:
        super().__init__()
        self.html = Markup()

    def show(self, html: Markup) -> None:
        if html != self.html:
            self.html = html
            self.run_method("show", html)


def put(html: Markup) -> ui.html:
    """Add HTML to the current section."""
    return ui.html(html, sanitize=False).classes("put")


def heading(text: str) -> None:
    """Add `markup.heading` to the current section."""
    put(markup.heading(text))


def note(text: str, *, kind: str = "", testid: str = "") -> None:
    """Add `markup.note` to the current section."""
    put(markup.note(text, kind=kind, testid=testid))


def checks(listed: Sequence[Check], *, testid: str) -> None:
    """Add `markup.checks` to the current section."""
    put(markup.checks(listed, testid=testid))


def table(columns: Sequence[str], rows: Sequence[Sequence[str]], *, testid: str) -> None:
    """Add `markup.table` to the current section."""
    put(markup.table(columns, rows, testid=testid))


def radio(button: ui.button, *, chosen: bool, first: bool) -> None:
    """Make a button one of a radio group; arrow keys move between them (page.js). `first`: Tab reaches it while none
    is chosen."""
    button.props(f"role=radio aria-checked={'true' if chosen else 'false'} tabindex={0 if chosen or first else -1}")


def action(text: str, handler: Any, *, testid: str, kind: str = "", enabled: bool = True) -> ui.button:
    """Add a button and return it; `kind`: primary, danger or plain."""
    button = ui.button(text, on_click=handler, color=None).classes(f"action {kind}".strip())
    button.props(f"no-caps unelevated data-testid={testid}")
    button.set_enabled(enabled)
    return button
