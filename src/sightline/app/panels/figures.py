"""The four live figures of a plan, each with its limit: errors of entry, tip and direction, and the procedure's own."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from sightline.app import texts
from sightline.app.panels import markup
from sightline.app.tab.tab import Tab
from sightline.checks import Check
from sightline.planning.procedures import Procedure
from sightline.planning.procedures import kind as kind_of

_ERRORS = ("entry error", "end error", "direction error")
_FALLBACK = "movement"  # of procedures without a check of their own that has a value and a limit
_ROOM = 1.25  # length of a bar over the larger one of value and limit [ours]
_FIGURE = (
    '<div class="figure {}"><div class="figure-name">{}</div><div class="figure-value">{}{}</div>{}'
    '<div class="figure-limit">{}</div></div>'
)
_BAR = '<div class="figure-bar" aria-hidden="true"><i style="width:{}%"></i><b style="left:{}%"></b></div>'
_NO_BAR = Markup('<div class="figure-bar" aria-hidden="true"></div>')  # while the limit is not known


@dataclass(frozen=True)
class _Figure:
    """`value`: None while it is not known."""

    name: str
    value: float | None
    limit: float | None
    unit: str
    passed: bool | None = None


def html(tab: Tab) -> Markup:
    """Return the four figures as HTML; before there is a plan without values."""
    known = tab.known
    verdict = tab.session.readiness.verdict_of(known)
    kind = kind_of(tab.planning.decisions.kind)
    return markup.filled(
        '<div class="figure-grid" data-testid="figures">{}</div>',
        markup.joined(*map(_html, _figures(kind, () if verdict is None else verdict.checks))),
    )


def _figures(kind: Procedure, checks: Iterable[Check]) -> list[_Figure]:
    """Return the figures of a procedure; a check that was made fills its figure."""
    made: dict[str, Check] = {}
    for check in checks:
        if check.figure is not None and check.limit is not None:
            made.setdefault(check.name, check)
    limits = kind.limits
    wanted = [
        _Figure(_ERRORS[0], None, limits.position_mm, "mm"),
        _Figure(_ERRORS[1], None, limits.position_mm, "mm"),
        _Figure(_ERRORS[2], None, float(np.rad2deg(limits.direction_rad)), "°"),
        _Figure(_own(kind, made), None, None, ""),
    ]
    return [_filled(one, made.get(one.name)) for one in wanted]


def _own(kind: Procedure, made: Iterable[str]) -> str:
    """Return the name of the procedure's own figure: of the check that `FIGURES` lists first."""
    asked = [name for name in texts.FIGURES if name in {rule.check for rule in kind.checks}]
    return next((name for name in asked if name in made), next(iter(asked), _FALLBACK))


def _filled(figure: _Figure, check: Check | None) -> _Figure:
    if check is None:
        return figure
    return _Figure(figure.name, check.figure, check.limit, check.unit, check.passed)


def _html(figure: _Figure) -> Markup:
    name, value, limit = texts.FIGURES[figure.name], figure.value, figure.limit
    if value is None or limit is None:
        bar = markup.filled(_BAR, 0, f"{100 / _ROOM:.0f}") if limit is not None else _NO_BAR
        said = "" if limit is None else texts.FIGURE_AT_MOST.format(limit=_number(limit, figure.unit))
        return markup.filled(_FIGURE, "open", name, "–", "", bar, said)
    whole = _ROOM * max(abs(value), abs(limit), 1e-9)
    share, at = (f"{min(max(100 * x / whole, 0), 100):.0f}" for x in (value, limit))
    most = (value <= limit) == figure.passed
    said = (texts.FIGURE_AT_MOST if most else texts.FIGURE_AT_LEAST).format(limit=_number(limit, figure.unit))
    state, sign = ("passed", texts.FIGURE_PASSED) if figure.passed else ("failed", texts.FIGURE_FAILED)
    sign = markup.filled('<span class="figure-sign" role="img" aria-label="{}"></span>', sign)
    return markup.filled(_FIGURE, state, name, _number(value, figure.unit), sign, markup.filled(_BAR, share, at), said)


def _number(value: float, unit: str) -> str:
    digits = 2 if abs(value) < 10 and unit != "σ" else 1
    return f"{value:.{digits}f}{unit if unit == '°' else f' {unit}'}"
