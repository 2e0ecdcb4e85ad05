"""Parts of the page as HTML. Text that is not `Markup` is escaped."""

from collections.abc import Callable, Sequence
from functools import lru_cache

from markupsafe import Markup, escape

from sightline.app import texts
from sightline.common.checks import Check, CheckCode
from sightline.planning.procedures.document import ABOVE_ERROR

_CHECK = (
    '<li class="{0}"><div class="check-head"><div class="mark" aria-hidden="true">{1}</div>'
    '<div class="check-name">{2}</div><div class="check-figure">{3}</div>'
    '<div class="unseen">{5}</div></div><div class="check-sentence">{4}</div></li>'
)


_SHOWN, _MORE = 3, 4  # significant digits of a value, and how many more may tell it from its limit [ours]
_LONG = 120  # characters of a card's text that is written smaller, to fit [ours]
_CARD = (
    '<div class="verdict {}" data-testid="{}"><div class="verdict-word">{}</div>'
    '<div class="verdict-sentence {}">{} <span class="verdict-more">{}</span></div></div>'
)


def filled(template: str, *values: object) -> Markup:
    """Return a template filled with values; those that are not `Markup` are escaped. (`Markup.format` takes ten times
    as long, too long for a page that follows a drag.)"""
    return Markup(template.format(*map(escape, values)))  # noqa: S704 - every value is escaped


def joined(*pieces: Markup) -> Markup:
    """Return the pieces concatenated."""
    return Markup().join(pieces)


def heading(text: str) -> Markup:
    """Return a heading within a panel."""
    return filled("<h2>{}</h2>", text)


def note(text: str, *, kind: str = "", testid: str = "") -> Markup:
    """Return a sentence; `kind`: good, warn, bad or quiet."""
    return filled('<div class="note {}"{}>{}</div>', kind, _testid(testid), text)


def card(state: str, word: str, sentence: str, more: str = "", *, testid: str) -> Markup:
    """Return a card with a verdict; `state`: go, no-go or incomplete."""
    size = "long" if len(sentence) + len(more) > _LONG else ""
    return filled(_CARD, state, testid, word, size, sentence, more)


def checks(listed: Sequence[Check], *, testid: str, kind: str = "") -> Markup:
    """Return checks with value, limit and sentence, the failed ones first. `kind`: as of `texts.sentence`."""
    items = (_check(check, kind) for check in sorted(listed, key=lambda check: check.passed))
    return filled('<ul class="checks"{}>{}</ul>', _testid(testid), joined(*items))


def table(
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
def _check(check: Check, kind: str) -> Markup:
    state, sign = ("passed", "✓") if check.passed else ("failed", "✕")
    return filled(_CHECK, state, sign, check.name, _figure(check), texts.sentence(check, kind), state)


def _figure(check: Check) -> str:
    """Return the value of a check with its limit, as text."""
    if check.figure is None:
        return ""
    if check.limit is None:
        return _quantity(check.figure, check.unit, _SHOWN)
    most = (check.figure <= check.limit) == check.passed
    value, bound = apart(check.figure, check.limit, check.unit, _quantity, _SHOWN, passed=check.passed)
    return f"{value}, {limit_said(check.code, bound, most=most)}"


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
    return f"{value:.{digits}g}{'' if unit == '°' else ' '}{unit}".strip()
