"""The four live figures of a plan, each with its limit: errors of entry, tip and direction, and the procedure's own."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from markupsafe import Markup

from sightline.app import texts
from sightline.app.panels import markup
from sightline.app.tab.tab import Tab
from sightline.checks import Check, Code
from sightline.planning import Plan
from sightline.planning.points.results import MAX_GAP_SIGMA
from sightline.planning.procedures import Procedure
from sightline.planning.procedures import kind as kind_of

_ERRORS = (Code.ENTRY_ERROR, Code.END_ERROR, Code.DIRECTION_ERROR)
_FALLBACK = Code.MOVEMENT  # of procedures without a check of their own that has a value and a limit
_DIGITS = 2  # decimals of a value below 10, one less above [ours]
_ROOM = 1.25  # length of a bar over the larger one of value and limit [ours]
_FIGURE = (
    '<div class="figure {}"><div class="figure-name">{}</div><div class="figure-value">{}{}</div>{}'
    '<div class="figure-limit">{}</div></div>'
)
_BAR = '<div class="figure-bar" aria-hidden="true"><i style="width:{}%"></i><b style="left:{}%"></b></div>'
_NO_BAR = Markup('<div class="figure-bar" aria-hidden="true"></div>')  # while the limit is not known


@dataclass(frozen=True)
class _Figure:
    """`value`: None while it is not known; then `said` stands in its place."""

    code: Code
    value: float | None
    limit: float | None
    unit: str
    passed: bool | None = None
    said: str = "–"


def html(tab: Tab) -> Markup:
    """Return the four figures as HTML; before there is a plan without values."""
    plan = None if tab.known is None else tab.known.plan
    return markup.filled(
        '<div class="figure-grid" data-testid="figures">{}</div>',
        markup.joined(*map(_html, _figures(kind_of(tab.planning.decisions.kind), plan))),
    )


def _figures(kind: Procedure, plan: Plan | None) -> list[_Figure]:
    """Return the figures of a procedure; a check that was made of the current wire fills its figure."""
    made: dict[Code, Check] = {}
    for check in () if plan is None else plan.verdict.checks:
        if check.figure is not None and check.limit is not None:
            made.setdefault(check.code, check)
    limits = kind.limits
    wanted = [
        _Figure(_ERRORS[0], None, limits.position_mm, "mm"),
        _Figure(_ERRORS[1], None, limits.position_mm, "mm"),
        _Figure(_ERRORS[2], None, float(np.rad2deg(limits.direction_rad)), "°"),
        _Figure(_own(kind, made), None, None, ""),
    ]
    filled = [_filled(one, made.get(one.code)) for one in wanted]
    return [_of_movement(one, plan) if plan is not None and one.code is _FALLBACK else one for one in filled]


def _own(kind: Procedure, made: Iterable[Code]) -> Code:
    """Return the code of the procedure's own figure: of the check that `FIGURES` lists first."""
    asked = [code for code in texts.FIGURES if code in {rule.code for rule in kind.checks}]
    return next((code for code in asked if code in made), next(iter(asked), _FALLBACK))


def _filled(figure: _Figure, check: Check | None) -> _Figure:
    if check is None:
        return figure
    return _Figure(figure.code, check.figure, check.limit, check.unit, check.passed)


def _of_movement(figure: _Figure, plan: Plan) -> _Figure:
    """Return the movement of the bone in mm instead of standard deviations; in words for three images, which test
    several movements at once."""
    if figure.passed is None:
        return figure
    shift, sd = plan.seen.shift_mm, plan.seen.shift_sd_mm
    if plan.seen.movement is not None or shift is None or sd is None:
        return replace(figure, value=None, limit=None, said=texts.FIGURE_MOVED[figure.passed])
    return replace(figure, value=abs(shift), limit=MAX_GAP_SIGMA * sd, unit="mm")


def _html(figure: _Figure) -> Markup:
    name, value, limit = texts.FIGURES[figure.code], figure.value, figure.limit
    state = {None: "open", True: "passed", False: "failed"}[figure.passed]
    sign = Markup()
    if figure.passed is not None:
        told = texts.FIGURE_PASSED if figure.passed else texts.FIGURE_FAILED
        sign = markup.filled('<span class="figure-sign" role="img" aria-label="{}"></span>', told)
    if value is None or limit is None:
        bar = markup.filled(_BAR, 0, f"{100 / _ROOM:.0f}") if limit is not None else _NO_BAR
        said = "" if limit is None else texts.FIGURE_AT_MOST.format(limit=_number(limit, figure.unit, _DIGITS))
        return markup.filled(_FIGURE, state, name, figure.said, sign, bar, said)
    whole = _ROOM * max(abs(value), abs(limit), 1e-9)
    share, at = (f"{min(max(100 * x / whole, 0), 100):.0f}" for x in (value, limit))
    shown, bound = markup.apart(value, limit, figure.unit, _number, _DIGITS, passed=bool(figure.passed))
    said = markup.limit_said(figure.code, bound, most=(value <= limit) == figure.passed)
    return markup.filled(_FIGURE, state, name, shown, sign, markup.filled(_BAR, share, at), said)


def _number(value: float, unit: str, digits: int) -> str:
    return f"{value:.{digits if abs(value) < 10 else digits - 1}f}{unit if unit == '°' else f' {unit}'}"
