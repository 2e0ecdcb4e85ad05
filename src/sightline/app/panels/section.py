"""Parts of the page that are redrawn only when their content changes, as elements or as HTML, and buttons, with or
without a question. Text that is not `Markup` is escaped."""

from collections.abc import Awaitable, Callable, Generator, Hashable, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

from markupsafe import Markup, escape
from nicegui import ui
from nicegui.events import handle_event

from sightline.app import texts
from sightline.app.drawing.calls import Calling
from sightline.app.session.jobs import failure_of
from sightline.app.tab.tab import Tab
from sightline.common.checks import Check, CheckCode
from sightline.planning.procedures.document import ABOVE_ERROR

_CHECK = (
    '<li class="{0}"><div class="check-head"><div class="mark" aria-hidden="true">{1}</div>'
    '<div class="check-name">{2}</div><div class="check-figure">{3}</div>'
    '<div class="unseen">{5}</div></div><div class="check-sentence">{4}</div></li>'
)


# Significant digits of a value, which no error is smaller than, and how many more may tell it from its limit [ours].
_SHOWN, _MORE = 3, 4
LONG, LONGER = 110, 190  # [ours] characters from which a card's text or an instruction is written smaller, to fit
_CARD = (
    '<div class="verdict {}" data-testid="{}"><div class="verdict-word">{}</div>'
    '<div class="verdict-sentence {}">{} <span class="verdict-more">{}</span></div>{}</div>'
)


def filled(template: str, *values: object) -> Markup:
    """Return a template filled with values; those that are not `Markup` are escaped. (`Markup.format` takes ten times
    as long, too long for a page that follows a drag.)"""
    return Markup(template.format(*map(escape, values)))  # noqa: S704 - every value is escaped


def joined(*pieces: Markup) -> Markup:
    """Return the pieces concatenated."""
    return Markup().join(pieces)


def heading_html(text: str) -> Markup:
    """Return a heading within a panel."""
    return filled("<h2>{}</h2>", text)


def note_html(text: str, *, kind: str = "", testid: str = "") -> Markup:
    """Return a sentence; `kind`: good, warn, bad or quiet."""
    return filled('<div class="note {}"{}>{}</div>', kind, _testid(testid), text)


def card(state: str, word: str, sentence: str, more: str = "", *, testid: str, note: str = "") -> Markup:
    """Return a card with a verdict; `state`: go, no-go or incomplete; `note`: below its sentence."""
    size = "long" if len(sentence) + len(more) > LONG else ""
    return filled(_CARD, state, testid, word, size, sentence, more, note)


def checks_html(listed: Sequence[Check], *, testid: str, kind: str = "") -> Markup:
    """Return checks with value, limit and sentence, the failed ones first; what is said alike of several views once.
    `kind`: as of `texts.sentence`."""
    alike: dict[tuple[object, ...], list[Check]] = {}
    for check in sorted(listed, key=lambda check: check.passed):
        sentence = check.sentence.removeprefix(f"{check.view}: ")
        alike.setdefault((check.passed, check.name, _figure(check), sentence, bool(check.view)), []).append(check)
    items = (_check(same[0], kind, tuple(each.view for each in same if each.view)) for same in alike.values())
    return filled('<ul class="checks"{}>{}</ul>', _testid(testid), joined(*items))


def table_html(
    columns: Sequence[str], rows: Sequence[Sequence[str]], *, testid: str, classes: str = "", label: str = ""
) -> Markup:
    """Return a small table; the first cell of a row is its header."""
    names = joined(*(filled('<th scope="col">{}</th>', name) for name in columns)) if any(columns) else Markup()
    named = filled(' class="{}" aria-label="{}"', classes, label) if label else Markup()
    return filled(
        "<table{}{}>{}{}</table>",
        _testid(testid),
        named,
        filled("<tr>{}</tr>", names) if names else names,
        joined(*map(_row, rows)),
    )


def _testid(testid: str) -> Markup:
    return filled(' data-testid="{}"', testid) if testid else Markup()


def _row(cells: Sequence[str]) -> Markup:
    name, *others = cells
    named = filled('<th scope="row">{}</th>', name)
    return filled("<tr>{}{}</tr>", named, joined(*(filled("<td>{}</td>", cell) for cell in others)))


@lru_cache(maxsize=256)  # most checks stay as they are when a point moves
def _check(check: Check, kind: str, views: tuple[str, ...]) -> Markup:
    state, sign = ("passed", "✓") if check.passed else ("failed", "✕")
    return filled(_CHECK, state, sign, check.name, _figure(check), texts.sentence(check, kind, views), state)


def _figure(check: Check) -> str:
    """Return the value of a check with its limit, as text."""
    if check.figure is None:
        return ""
    if check.limit is None:
        return _quantity(check.figure, check.unit, _SHOWN)
    value, bound = apart(check.figure, check.limit, check.unit, _quantity, _SHOWN, passed=check.passed)
    return f"{value}, {limit_said(check.code, bound, most=not check.bounds_below)}"


def limit_said(code: CheckCode, bound: str, *, most: bool) -> str:
    """Return what the limit of a check means, in words. `most`: the value must be below it."""
    if code in ABOVE_ERROR:
        return f"± {bound} (95 %)"
    return f"at {'most' if most else 'least'} {bound}"


def apart(
    value: float, limit: float, unit: str, text: Callable[[float, str, int], str], digits: int, *, passed: bool
) -> tuple[str, str]:
    """Return a value and its limit as text, `text(value, unit, digits)`: of a failure with so many more digits that
    they are not the same."""
    most = digits + _MORE
    while not passed and digits < most and text(value, unit, digits) == text(limit, unit, digits):
        digits += 1
    return text(value, unit, digits), text(limit, unit, digits)


def _quantity(value: float, unit: str, digits: int) -> str:
    return texts.unsigned(f"{value:.{digits}g}{'' if unit == '°' else ' '}{unit}".strip())


Key = Callable[[Tab], Hashable]
LIVE_S = 0.2  # [ours] update period of the robot's readings and its pose: nobody reads faster


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
                called[:] = [callback for callback in called if callback != self.refresh]
            return
        keys: list[Hashable] = []
        refused = failure_of(lambda: keys.append(self._key(self._tab)))
        key = (refused, *keys)
        if key != self._shown:
            self._shown = key
            self._fill(refused)

    def _fill(self, refused: str) -> None:
        raise NotImplementedError


class Section(_Part):
    """A part that `build(tab)` fills with elements. Sections may contain sections, so that rebuilding one does not lose
    text typed into another. A button that is built again is the same element, so that a click on its way to the
    program is not lost; it does what it does now."""

    def __init__(self, tab: Tab, key: Key, build: Callable[[Tab], None], *, classes: str = "") -> None:
        self._build, self._buttons = build, _Box().classes(classes)
        super().__init__(tab, key, self._buttons)

    def _fill(self, refused: str) -> None:
        with self._buttons.keeping(), self._box:
            refused = refused or failure_of(lambda: self._build(self._tab))
            if refused:
                self._box.clear()  # half a section could mislead
                note(refused, kind="bad", testid="section-refused")


class _Box(ui.element):
    """The element of a section. `kept`: its buttons from before, by test hook and text, while it is built again."""

    def __init__(self) -> None:
        super().__init__("section")
        self.kept: dict[tuple[str, str], _Action] = {}

    @contextmanager
    def keeping(self) -> Generator[None]:
        """Clear it, and delete the buttons that are not built again."""
        with self.client.layout:
            aside = ui.element()
        aside.set_visibility(False)
        for button in [element for element in self.descendants() if isinstance(element, _Action)]:
            self.kept[button.key] = button.move(aside)
        self.clear()
        try:
            yield
        finally:
            self.kept.clear()
            aside.delete()


class _Action(ui.button):
    """A button whose handler can be replaced. `key`: test hook and text."""

    def __init__(self, key: tuple[str, str], handler: Any) -> None:
        self.key, self.handler = key, handler
        super().__init__(key[1], color=None)
        self.on_click(lambda event: handle_event(self.handler, event))


class PersistentSection(_Part):
    """A part that `build(tab)` fills once; it returns the function that updates it. Its buttons persist during a
    refresh, so that clicks are not lost."""

    def __init__(self, tab: Tab, key: Key, build: Callable[[Tab], Callable[[], None]], *, classes: str = "") -> None:
        with ui.element("section").classes(classes) as box:
            self._update = build(tab)
        super().__init__(tab, key, box)

    def _fill(self, refused: str) -> None:
        if why := refused or failure_of(self._update):
            self._tab.notify(why)


class HtmlSection(_Part):
    """A part that `html(tab)` fills with HTML, fast enough to follow a drag. `drag`: it does, because its content
    depends on the preview. One that does not is built anew whenever its key changes, so that a notice that is repeated
    is announced again."""

    def __init__(
        self, tab: Tab, key: Key, html: Callable[[Tab], Markup], *, classes: str = "", drag: bool = True
    ) -> None:
        self._html, self._element, self._again = html, _Html(), not drag
        if drag:
            tab.on_drag.append(self.refresh)
        super().__init__(tab, key, self._element.classes(classes))

    def _fill(self, refused: str) -> None:
        made: list[Markup] = []
        refused = refused or failure_of(lambda: made.append(self._html(self._tab)))
        html = note_html(refused, kind="bad", testid="section-refused") if refused else made[0]
        self._element.show(html, again=self._again)


class _Html(Calling, component=Path(__file__).parent / "html_section.js"):
    def __init__(self) -> None:
        super().__init__()
        self.html = Markup()

    def show(self, html: Markup, *, again: bool) -> None:
        """Show this HTML. `again`: build it anew where it is shown already."""
        same = html == self.html
        self.html = html
        if not same or again:
            self.run_method("show", html, same)


def put(html: Markup) -> ui.html:
    """Add HTML to the current section."""
    return ui.html(html, sanitize=False).classes("put")


def heading(text: str) -> None:
    """Add `heading_html` to the current section."""
    put(heading_html(text))


def note(text: str, *, kind: str = "", testid: str = "") -> None:
    """Add `note_html` to the current section."""
    put(note_html(text, kind=kind, testid=testid))


def checks(listed: Sequence[Check], *, testid: str) -> None:
    """Add `checks_html` to the current section."""
    put(checks_html(listed, testid=testid))


def table(columns: Sequence[str], rows: Sequence[Sequence[str]], *, testid: str) -> None:
    """Add `table_html` to the current section."""
    put(table_html(columns, rows, testid=testid))


def decided(tab: Tab, text: str, member: str) -> None:
    """Add a check box for a member of the decisions."""
    on = getattr(tab.planning.decisions, member)
    ui.checkbox(
        text, value=on, on_change=lambda event: tab.act(lambda: tab.planning.decide(**{member: bool(event.value)}))
    ).props(f"data-testid={member}")


def shown_or_not(tab: Tab, text: str, member: str) -> None:
    """Add a check box for a member of the views, which shows something or does not."""
    on = getattr(tab.views, member)
    ui.checkbox(
        text, value=on, on_change=lambda event: tab.act(lambda: setattr(tab.views, member, bool(event.value)))
    ).props(f"data-testid={member.replace('_', '-')}")


def radio(button: ui.button, *, chosen: bool, first: bool) -> None:
    """Make a button one of a radio group; arrow keys move between them (page.js). `first`: Tab reaches it while none
    is chosen."""
    button.props(f"role=radio aria-checked={'true' if chosen else 'false'} tabindex={0 if chosen or first else -1}")


def action(text: str, handler: Any, *, testid: str, kind: str = "", enabled: bool = True) -> ui.button:
    """Add a button and return it, empty but for its text; `kind`: primary, danger or plain."""
    button = _again((testid, text), handler) or _Action((testid, text), handler)
    button.classes(replace=f"action {kind}".strip())
    button.props(f"no-caps unelevated data-testid={testid}")
    button.set_enabled(enabled)
    return button


def _again(key: tuple[str, str], handler: Any) -> _Action | None:
    """Return the button from before of a section that is built again, moved to where it is built now."""
    here = ui.context.slot.parent
    boxes = (
        element for element in here.ancestors(include_self=True) if isinstance(element, _Box) and key in element.kept
    )
    box = next(boxes, None)
    if box is None:
        return None
    button = box.kept.pop(key)
    button.clear()
    button.set_visibility(True)
    button.handler = handler
    return button.move(here)


def confirmed_action(
    tab: Tab,
    text: str,
    question: str,
    command: Callable[[], Awaitable[object] | None],
    testid: str,
    *,
    what: str = "",
    enabled: bool,
    kind: str = "primary",
) -> None:
    """Build a button that asks for confirmation before it acts."""

    def ask() -> None:
        # On the page, not in this section: the question stays when the robot's state rebuilds the section. A command
        # that no longer fits is refused by what it calls.
        with ui.context.client, ui.dialog().props(f'aria-label="{text}"') as dialog, ui.card().classes("question"):
            ui.label(question).classes("question-text")
            if what:
                ui.label(what)

            async def agreed() -> None:
                dialog.close()
                await tab.act(command)

            with ui.element("div").classes("choice"):
                action("Cancel", dialog.close, testid=f"{testid}-cancel", kind="plain")
                action(text, agreed, testid=f"{testid}-yes", kind="primary")
        dialog.on("hide", dialog.delete)
        dialog.open()

    action(text, ask, testid=testid, kind=kind, enabled=enabled)
