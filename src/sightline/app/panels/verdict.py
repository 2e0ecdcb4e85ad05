"""The verdict, GO or NO-GO: the four live figures with their limits, all checks, the error budget, and what to do."""

from collections.abc import Hashable, Iterable
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from markupsafe import Markup

from sightline.app import texts
from sightline.app.panels.section import (
    HtmlSection,
    apart,
    card,
    checks_html,
    filled,
    heading_html,
    joined,
    limit_said,
    note_html,
    table_html,
)
from sightline.app.panels.steps import aid_labels, missing_labels, needed_aids, refusals
from sightline.app.plan.marks import label_of
from sightline.app.tab.tab import Tab
from sightline.common.checks import Check, CheckCode, advised, failed
from sightline.errors import SightlineError
from sightline.planning import Plan
from sightline.planning.points.results import MAX_GAP_SIGMA
from sightline.planning.points.trajectory import Share, error_shares, error_shares_of
from sightline.planning.procedures import Procedure
from sightline.planning.procedures import kind as kind_of
from sightline.robot.kinematics.target import RobotTarget

_ERRORS = (CheckCode.ENTRY_ERROR, CheckCode.END_ERROR, CheckCode.DIRECTION_ERROR)
_FALLBACK = CheckCode.MOVEMENT  # of procedures without a check of their own that has a value and a limit
_DIGITS = 2  # [ours] decimals of a value below 10, one less above: a hundredth is below every error
_ROOM = 1.25  # [ours] length of a bar over the larger one of value and limit, so that neither is at its end
_FIGURE = (
    '<div class="figure {}"><div class="figure-name">{}</div><div class="figure-value">{}{}</div>{}'
    '<div class="figure-limit">{}</div></div>'
)
_BAR = '<div class="figure-bar" aria-hidden="true"><i style="width:{}%"></i><b style="left:{}%"></b></div>'
_NO_BAR = Markup('<div class="figure-bar" aria-hidden="true"></div>')  # while the limit is not known


@dataclass(frozen=True)
class _Figure:
    """`value`: None while it is not known; then `words` stand in its place. `error`: its 95 % error, where shown."""

    code: CheckCode
    value: float | None
    limit: float | None
    unit: str
    passed: bool | None = None
    words: str = "–"
    error: float | None = None
    bounds_below: bool = False  # as of `Check`


def figures_html(tab: Tab) -> Markup:
    """Return the four figures as HTML; before there is a plan without values."""
    plan = None if tab.known is None else tab.known.plan
    return filled(
        '<div class="figure-grid" data-testid="figures">{}</div>',
        joined(*map(_figure_html, _figures(kind_of(tab.planning.decisions.kind), plan))),
    )


def _figures(kind: Procedure, plan: Plan | None) -> list[_Figure]:
    """Return the figures of a procedure; a check that was made of the current wire fills its figure."""
    made: dict[CheckCode, Check] = {}
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
    filled = [_filled(figure, made.get(figure.code)) for figure in wanted]
    return [
        _of_movement(figure, plan) if plan is not None and figure.code is _FALLBACK else figure for figure in filled
    ]


def _own(kind: Procedure, made: Iterable[CheckCode]) -> CheckCode:
    """Return the code of the procedure's own figure: of the check that `FIGURES` lists first."""
    asked = [code for code in texts.FIGURES if code in {rule.code for rule in kind.checks}]
    return next((code for code in asked if code in made), next(iter(asked), _FALLBACK))


def _filled(figure: _Figure, check: Check | None) -> _Figure:
    if check is None:
        return figure
    return _Figure(
        figure.code, check.figure, check.limit, check.unit, check.passed, "–", check.error_95, check.bounds_below
    )


def _of_movement(figure: _Figure, plan: Plan) -> _Figure:
    """Return the movement of the bone in mm instead of standard deviations; in words for three images, which test
    several movements at once."""
    if figure.passed is None:
        return figure
    shift, sd = plan.seen.shift_mm, plan.seen.shift_sd_mm
    if plan.seen.movement is not None or shift is None or sd is None:
        return replace(figure, value=None, limit=None, words=texts.FIGURE_MOVED[figure.passed])
    return replace(figure, value=abs(shift), limit=MAX_GAP_SIGMA * sd, unit="mm")


def _figure_html(figure: _Figure) -> Markup:
    name, value, limit = texts.FIGURES[figure.code], figure.value, figure.limit
    state = {None: "open", True: "passed", False: "failed"}[figure.passed]
    sign = Markup()
    if figure.passed is not None:
        label = texts.FIGURE_PASSED if figure.passed else texts.FIGURE_FAILED
        sign = filled('<span class="figure-sign" role="img" aria-label="{}"></span>', label)
    if value is None or limit is None:
        bar = filled(_BAR, 0, f"{100 / _ROOM:.0f}") if limit is not None else _NO_BAR
        text = "" if limit is None else f"at most {_number(limit, figure.unit, _DIGITS)}"
        return filled(_FIGURE, state, name, figure.words, sign, bar, text)
    whole = _ROOM * max(abs(value), abs(limit), 1e-9)
    share, at = (f"{min(max(100 * x / whole, 0), 100):.0f}" for x in (value, limit))
    shown, bound = apart(value, limit, figure.unit, _number, _DIGITS, passed=bool(figure.passed))
    text = limit_said(figure.code, bound, most=not figure.bounds_below)
    if figure.error is not None:
        text = f"± {figure.error:.1f}, {text.removesuffix(figure.unit).strip()}"
    return filled(_FIGURE, state, name, shown, sign, filled(_BAR, share, at), text)


def _number(value: float, unit: str, digits: int) -> str:
    number = texts.unsigned(f"{value:.{digits if abs(value) < 10 else digits - 1}f}")
    return f"{number}{unit if unit == '°' else f' {unit}'}"


SOURCES = {  # sources of error, with their colours (colours.js)
    "beads": "sky",
    "map": "green",
    "focal_point": "yellow",
    "frame": "orange",
    "picks": "purple",
    "robot": "vermillion",
}


def key(tab: Tab) -> Hashable:
    """Key of the verdict."""
    listed, lacking = _listed(tab), tab.planning.lacking
    wrong = tuple(check.sentence for check in failed(listed))
    return len(listed), wrong, left(tab), _refused(tab), lacking, _unnoticed(tab)


def left(tab: Tab) -> tuple[str, ...]:
    """Return what is left to do before a verdict: points to place, what a person must confirm, and aids to draw."""
    decisions, known, verdict = tab.planning.decisions, tab.planning.planned, tab.session.readiness.verdict
    if known is None:
        return ("two calibrated images",)
    left_out = {spec.name for spec in tab.skipped}
    asked = [spec for spec in tab.planning.asked if not decisions.complete([spec.name]) and spec.name not in left_out]
    confirmed = (("patient's side", decisions.side), ("frame's serial", decisions.serial))
    aids = () if verdict is None else needed_aids(known, verdict)
    return (
        *(label_of(tuple(same)) for _, same in groupby(asked, key=lambda spec: spec.of)),
        *missing_labels(tab.planning),
        *(what for what, value in confirmed if value is None),
        *aid_labels(known.kind, aids),
    )


def _refused(tab: Tab) -> tuple[str, ...]:
    """Return the reasons, each once, why a nail that is drawn, or points that are all placed, give no plan."""
    known, search = tab.known, tab.planning.nail
    if known is None or not (known.decisions.of_nail or known.refused.get("plan")):
        return ()
    return (texts.SEARCHING_NAIL,) if search.searching else refusals(known)


def details_key(tab: Tab) -> Hashable:
    """Key of the details."""
    session, decisions = tab.session, tab.planning.decisions
    return (tab.known, session.age.fresh, decisions.side, decisions.serial, session.readiness.go, _target(tab))


def _listed(tab: Tab) -> tuple[Check, ...]:
    """Return all checks of the plan shown; none without a plan."""
    verdict = tab.session.readiness.verdict_of(tab.known)
    return () if verdict is None else verdict.checks


def _unnoticed(tab: Tab) -> str:
    """Return which errors no check notices, as a sentence, of a plan that is GO; "" of any other."""
    plan, verdict = None if tab.known is None else tab.known.plan, tab.session.readiness.verdict_of(tab.known)
    return "" if plan is None or verdict is None or not verdict.go else plan.unnoticed


def html(tab: Tab) -> Markup:
    """Return the verdict as HTML: of a plan that is GO which errors no check notices, of one that is NO-GO the first
    thing to do, of an incomplete one what is left, or what the patient does not have."""
    if lacking := tab.planning.lacking:
        state, (sentence, _) = "incomplete", texts.LACKS[lacking]
        return card(state, texts.VERDICTS[state], sentence, "", testid="verdict")
    verdict, missing = tab.session.readiness.verdict_of(tab.known), left(tab)
    state = "incomplete" if verdict is None else verdict.state
    if verdict is None or state == "incomplete":
        unmade = () if verdict is None else tuple(dict.fromkeys(verdict.missing))
        refused = _refused(tab)
        left_said = () if not missing else (texts.LEFT.format(what=", ".join(missing)),)
        sentence, *others = refused or left_said or unmade or ("",)
        more = len(others)
    else:
        kind = tab.planning.decisions.kind
        wrong = [check for check in advised(verdict.checks) if not check.missing]
        sentence = texts.sentence(wrong[0], kind) if wrong else "Every check passed. A person decides."
        more = len(wrong) - 1
    more_text, unnoticed = texts.MORE.format(count=more) if more > 0 else "", _unnoticed(tab)
    note = note_html(unnoticed, kind="warn", testid="unnoticed") if unnoticed else ""
    return card(state, texts.VERDICTS[state], sentence, more_text, testid="verdict", note=note)


def build_details(tab: Tab) -> None:
    """Build the error budget and the list of all checks with value and limit."""
    HtmlSection(tab, details_key, _all_checks)
    HtmlSection(tab, details_key, _shares)


def _all_checks(tab: Tab) -> Markup:
    listed, kind = _listed(tab), tab.planning.decisions.kind
    if not listed:
        return Markup()
    return joined(
        heading_html(f"All {len(listed)} checks"),
        checks_html(listed, testid="verdict-checks", kind=kind),
    )


def _shares(tab: Tab) -> Markup:
    """Return the error budget as a table with coloured bars."""
    known = tab.known
    if known is None or known.plan is None:
        return Markup()
    try:
        target = _target(tab)
        if target is not None:
            ends = np.stack([target.entry_mm, target.end_mm])
            shares = error_shares_of(ends, target.budget_mm2)
        else:
            shares = error_shares(known.plan.trajectory)
    except SightlineError:
        return Markup()
    together = [_together(share) for share in shares.values()]
    unknown = ("robot",) if target is None else ()  # its errors are known once it has the plan
    columns = [f"{texts.SHARES_OF[what]}, {share.unit}" for what, share in shares.items()]
    rows = [
        (
            filled('<i style="background:{}"></i>{}', _colour(source), source.replace("_", " ")),
            *(
                "–" if source in unknown else _part(share, percent[source])
                for share, percent in zip(shares.values(), together, strict=True)
            ),
        )
        for source in SOURCES
    ]
    whole = ("together", *(_part(share, 100.0) for share in shares.values()))
    return joined(
        heading_html("Where the error comes from"),
        note_html("Root mean squares, smaller than the 95 % errors, and shares of their squares.", kind="quiet"),
        filled('<div aria-hidden="true">{}</div>', joined(*map(_bar, together))),
        table_html(
            ("source", *columns),
            [*rows, whole],
            testid="shares",
            classes="shares",
            label="Root mean square of each source, and its share",
        ),
    )


def _target(tab: Tab) -> RobotTarget | None:
    """Return the robot's target for the plan shown; None before it is sent, and for another plan."""
    drilling, session = tab.session.drilling, tab.session.drilling.session
    shown = drilling.held is not None and not drilling.changed and tab.known is tab.planning.planned
    return session.target if session is not None and shown else None


def _together(share: Share) -> dict[str, float]:
    """Return percentages by source; the robot's sources are combined."""
    together = dict.fromkeys(SOURCES, 0.0)
    for source, percent in share.percent.items():
        together[source if source in SOURCES else "robot"] += percent
    return together


def _bar(percent: dict[str, float]) -> Markup:
    pieces = (
        filled('<i style="width:{}%;background:{}"></i>', f"{of:.2f}", _colour(source))
        for source, of in percent.items()
    )
    return filled('<div class="share">{}</div>', joined(*pieces))


def _part(share: Share, percent: float) -> Markup:
    """Return a source's contribution; squares of root mean squares add up."""
    own = share.rms * np.sqrt(percent / 100.0)
    return filled("{}<small>{} %</small>", f"{own:.2f}", f"{percent:.0f}")


def _colour(source: str) -> str:
    return f"var(--{SOURCES[source]})"
