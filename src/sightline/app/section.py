"""A part of the page that is built anew when what it shows is another, and left alone otherwise."""

from collections.abc import Callable, Hashable, Sequence
from typing import Any

from markupsafe import escape
from nicegui import ui

from sightline.app.tab import Tab, why_not
from sightline.checks import Check


class Section:
    """`build(tab)` fills the section, and again whenever `key(tab)` has changed. Sections may hold others: what is
    typed into one is not lost because another is built anew. Where either fails a sentence stands in its place, and
    the other sections go on."""

    def __init__(
        self, tab: Tab, key: Callable[[Tab], Hashable], build: Callable[[Tab], None], *, classes: str = ""
    ) -> None:
        self._tab, self._key, self._build = tab, key, build
        self._shown: Hashable = object()
        self._box = ui.element("section").classes(classes)
        tab.on_refresh.append(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        """Build it if it is to show something else."""
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
        self._box.clear()
        with self._box:
            refused = refused or why_not(lambda: self._build(self._tab))
            if refused:
                self._box.clear()  # half a section may say something else than the whole
                note(refused, kind="bad", testid="section-refused")


def heading(text: str) -> None:
    """Of a part of a panel."""
    with ui.element("h2"):
        ui.label(text)


def note(text: str, *, kind: str = "", testid: str = "") -> None:
    """A sentence; `kind`: good, warn, bad or quiet."""
    label = ui.label(text).classes(f"note {kind}".strip())
    if testid:
        label.props(f"data-testid={testid}")


def action(text: str, handler: Any, *, testid: str, kind: str = "", enabled: bool = True) -> ui.button:
    """A button; `kind`: primary, danger or plain."""
    button = ui.button(text, on_click=handler, color=None).classes(f"action {kind}".strip())
    button.props(f"no-caps unelevated data-testid={testid}")
    button.set_enabled(enabled)
    return button


def checks(listed: Sequence[Check], *, testid: str) -> None:
    """Checks with figure, limit and sentence, the failed ones first."""
    markup("".join(map(_item, sorted(listed, key=lambda one: one.passed))), "ul").classes("checks").props(
        f"data-testid={testid}"
    )


def _item(check: Check) -> str:
    name, sign = ("passed", "✓") if check.passed else ("failed", "✕")
    return (
        f'<li class="{name}"><div class="check-head"><div class="mark" aria-hidden="true">{sign}</div>'
        f'<div class="check-name">{escape(check.name)}</div><div class="check-figure">{escape(_figure(check))}</div>'
        f'<div class="unseen">{name}</div></div><div class="check-sentence">{escape(check.sentence)}</div></li>'
    )


def markup(html: str, tag: str) -> ui.html:
    """One element for many that follow a drag; a label for each takes 50 ms more. Whoever writes it escapes texts."""
    return ui.html(html, sanitize=False, tag=tag)


def _figure(check: Check) -> str:
    if check.figure is None:
        return ""
    limit = "" if check.limit is None else f" / {check.limit:.3g}"
    return f"{check.figure:.3g}{limit} {check.unit}".strip()


def table(columns: Sequence[str], rows: Sequence[Sequence[str]], *, testid: str) -> ui.html:
    """A small table; the first cell of a row names it. Text that is no `Markup` is escaped."""
    head = (
        "<tr>" + "".join(f'<th scope="col">{escape(column)}</th>' for column in columns) + "</tr>"
        if any(columns)
        else ""
    )
    body = (
        f'<tr><th scope="row">{escape(name)}</th>' + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>"
        for name, *cells in rows
    )
    return markup(head + "".join(body), "table").props(f"data-testid={testid}")
