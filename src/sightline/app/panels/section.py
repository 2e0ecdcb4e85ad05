"""A part of the page that is made anew when what it shows is another, and left alone otherwise."""

from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup
from nicegui import ui

from sightline.app.panels import markup
from sightline.app.session.failures import why_not
from sightline.app.tab.tab import Tab
from sightline.checks import Check

Key = Callable[[Tab], Hashable]


class _Part:
    """Filled, and again whenever `key(tab)` has changed. Where it fails a sentence stands in its place, and the other
    parts of the page go on."""

    def __init__(self, tab: Tab, key: Key, box: ui.element) -> None:
        self._tab, self._key, self._box = tab, key, box
        self._shown: Hashable = object()
        tab.on_refresh.append(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        """Fill it if it is to show something else."""
        if self._box.is_deleted:
            self._tab.on_refresh.remove(self.refresh)
            return
        found: list[Hashable] = []
        refused = why_not(lambda: found.append(self._key(self._tab)))
        key = (refused, *found)
        if key != self._shown:
            self._shown = key
            self._fill(refused)

    def _fill(self, refused: str) -> None:
        raise NotImplementedError


class Section(_Part):
    """`build(tab)` fills it with elements. Sections may hold others: what is typed into one is not lost because
    another is built anew."""

    def __init__(self, tab: Tab, key: Key, build: Callable[[Tab], None], *, classes: str = "") -> None:
        self._build = build
        super().__init__(tab, key, ui.element("section").classes(classes))

    def _fill(self, refused: str) -> None:
        self._box.clear()
        with self._box:
            refused = refused or why_not(lambda: self._build(self._tab))
            if refused:
                self._box.clear()  # half a section may say something else than the whole
                note(refused, kind="bad", testid="section-refused")


class Lasting(_Part):
    """`build(tab)` fills it once and gives what brings it up to date: a click on its way meets its button."""

    def __init__(self, tab: Tab, key: Key, build: Callable[[Tab], Callable[[], None]], *, classes: str = "") -> None:
        with ui.element("section").classes(classes) as box:
            self._update = build(tab)
        super().__init__(tab, key, box)

    def _fill(self, refused: str) -> None:
        self._tab.message = refused or why_not(self._update) or self._tab.message


class Following(_Part):
    """`html(tab)` fills it. A change is one message, and the page around it is left alone: it follows a drag."""

    def __init__(self, tab: Tab, key: Key, html: Callable[[Tab], Markup], *, classes: str = "") -> None:
        self._html, self._element = html, _Html()
        super().__init__(tab, key, self._element.classes(classes))

    def _fill(self, refused: str) -> None:
        made: list[Markup] = []
        refused = refused or why_not(lambda: made.append(self._html(self._tab)))
        self._element.show(markup.note(refused, kind="bad", testid="section-refused") if refused else made[0])


class _Html(ui.element, component=Path(__file__).parent / "following.js"):
    def __init__(self) -> None:
        super().__init__()
        self.html = Markup()

    def show(self, html: Markup) -> None:
        if html != self.html:
            self.html = html
            self.run_method("show", html)


def put(html: Markup) -> ui.html:
    """HTML among the elements of a section."""
    return ui.html(html, sanitize=False).classes("put")


def heading(text: str) -> None:
    """`markup.heading` among the elements of a section."""
    put(markup.heading(text))


def note(text: str, *, kind: str = "", testid: str = "") -> None:
    """`markup.note` among the elements of a section."""
    put(markup.note(text, kind=kind, testid=testid))


def checks(listed: Sequence[Check], *, testid: str) -> None:
    """`markup.checks` among the elements of a section."""
    put(markup.checks(listed, testid=testid))


def table(columns: Sequence[str], rows: Sequence[Sequence[str]], *, testid: str) -> None:
    """`markup.table` among the elements of a section."""
    put(markup.table(columns, rows, testid=testid))


def action(text: str, handler: Any, *, testid: str, kind: str = "", enabled: bool = True) -> ui.button:
    """A button; `kind`: primary, danger or plain."""
    button = ui.button(text, on_click=handler, color=None).classes(f"action {kind}".strip())
    button.props(f"no-caps unelevated data-testid={testid}")
    button.set_enabled(enabled)
    return button
