"""Parts of the page as HTML. Text that is not `Markup` is escaped."""

from collections.abc import Sequence

from markupsafe import Markup

from sightline.checks import Check

_CHECK = Markup(
    '<li class="{name}"><div class="check-head"><div class="mark" aria-hidden="true">{sign}</div>'
    '<div class="check-name">{check}</div><div class="check-figure">{figure}</div>'
    '<div class="unseen">{name}</div></div><div class="check-sentence">{sentence}</div></li>'
)


def joined(*pieces: Markup) -> Markup:
    """Return the pieces concatenated."""
    return Markup().join(pieces)


def heading(text: str) -> Markup:
    """Return a heading within a panel."""
    return Markup("<h2>{}</h2>").format(text)


def note(text: str, *, kind: str = "", testid: str = "") -> Markup:
    """Return a sentence; `kind`: good, warn, bad or quiet."""
    return Markup('<div class="note {}"{}>{}</div>').format(kind, _testid(testid), text)


def checks(listed: Sequence[Check], *, testid: str) -> Markup:
    """Return checks with value, limit and sentence, the failed ones first."""
    items = map(_check, sorted(listed, key=lambda one: one.passed))
    return Markup('<ul class="checks"{}>{}</ul>').format(_testid(testid), joined(*items))


def table(
    columns: Sequence[str], rows: Sequence[Sequence[str]], *, testid: str, classes: str = "", label: str = ""
) -> Markup:
    """Return a small table; the first cell of a row is its header."""
    names = joined(*map(Markup('<th scope="col">{}</th>').format, columns)) if any(columns) else Markup()
    named = Markup(' class="{}" aria-label="{}"').format(classes, label) if label else Markup()
    return Markup("<table{}{}>{}{}</table>").format(
        _testid(testid), named, Markup("<tr>{}</tr>").format(names) if names else names, joined(*map(_row, rows))
    )


def _testid(testid: str) -> Markup:
    return Markup(' data-testid="{}"').format(testid) if testid else Markup()


def _row(cells: Sequence[str]) -> Markup:
    name, *others = cells
    named = Markup('<th scope="row">{}</th>').format(name)
    return Markup("<tr>{}{}</tr>").format(named, joined(*map(Markup("<td>{}</td>").format, others)))


def _check(check: Check) -> Markup:
    name, sign = ("passed", "✓") if check.passed else ("failed", "✕")
    return _CHECK.format(name=name, sign=sign, check=check.name, figure=_figure(check), sentence=check.sentence)


def _figure(check: Check) -> str:
    if check.figure is None:
        return ""
    limit = "" if check.limit is None else f" / {check.limit:.3g}"
    return f"{check.figure:.3g}{limit} {check.unit}".strip()
