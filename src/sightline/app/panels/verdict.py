"""The verdict, GO or NO-GO: all checks, the error budget, the plan's age, and what to do."""

from collections.abc import Hashable

import numpy as np
from markupsafe import Markup
from nicegui import ui

from sightline.app import texts
from sightline.app.panels import markup
from sightline.app.panels.section import HtmlSection
from sightline.app.tab.tab import Tab
from sightline.checks import Check, failed
from sightline.errors import SightlineError
from sightline.planning.shares import Share, error_shares, error_shares_of
from sightline.robot.kinematics.target import LIFETIME_S, RobotTarget

SOURCES = {  # sources of error, with their colours (colours.js)
    "beads": "sky",
    "map": "green",
    "focal_point": "yellow",
    "frame": "orange",
    "picks": "purple",
    "robot": "vermillion",
}

_VERDICT = (
    '<div class="verdict {}" data-testid="verdict" role="status"><div class="verdict-word">{}</div>'
    '<div class="verdict-sentence">{}</div></div>'
)


def key(tab: Tab) -> Hashable:
    """Key of the verdict."""
    listed = _listed(tab)
    return len(listed), tuple(check.sentence for check in failed(listed))


def age_key(tab: Tab) -> Hashable:
    """Key of the plan's age: whether there is a plan, and whether it is fresh."""
    return bool(_listed(tab)), tab.session.age.fresh, tab.session.age.drilled_s


def count(tab: Tab) -> Hashable:
    """Key of the list of checks: their number."""
    return len(_listed(tab))


def details_key(tab: Tab) -> Hashable:
    """Key of the details."""
    session, decisions = tab.session, tab.planning.decisions
    return (tab.known, session.age.fresh, decisions.side, decisions.serial, session.readiness.go, _target(tab))


def _listed(tab: Tab) -> tuple[Check, ...]:
    """Return all checks of the plan shown; none without a plan."""
    verdict = tab.session.readiness.verdict_of(tab.known)
    return () if verdict is None else verdict.checks


def html(tab: Tab) -> Markup:
    """Return the verdict as HTML, with what to do about each failed check."""
    verdict = tab.session.readiness.verdict_of(tab.known)
    if verdict is None:
        return Markup()
    state, wrong = verdict.state, failed(verdict.checks)
    word, sentence = texts.VERDICTS[state]
    told = sentence.format(failed=len(wrong), all=len(verdict.checks))
    shown = markup.filled(_VERDICT, state, word, told)
    kinds = ["warn" if one in verdict.unmade else "bad" for one in wrong]
    return markup.joined(
        shown,
        *(markup.note(one.sentence, kind=kind, testid="do-about") for one, kind in zip(wrong, kinds, strict=True)),
    )


def build_details(tab: Tab) -> None:
    """Build the error budget and the list of all checks with value and limit."""
    listed = _listed(tab)
    if not listed:
        return
    HtmlSection(tab, details_key, _shares)
    with ui.element("details").props("data-testid=all-checks"):
        with ui.element("summary"):
            ui.label(texts.ALL_CHECKS.format(count=len(listed)))
        HtmlSection(tab, details_key, lambda t: markup.checks(_listed(t), testid="verdict-checks"))


def build_age(tab: Tab) -> None:
    """Build the text with the plan's age and expiry."""
    if not _listed(tab):
        return
    label = ui.label().classes("age").props("data-testid=age")
    age = tab.session.age
    was_fresh, drilled = age.fresh, age.drilled_s
    if drilled is not None:
        label.set_text(texts.SENT_AT.format(age=_minutes(drilled)))
        return

    def tell() -> None:
        age_s = age.now_s
        if age_s is None:
            return
        if age.fresh != was_fresh:
            tab.refresh()  # GO must not be shown for a plan that has expired
            return
        told = texts.EXPIRES.format(age=_minutes(age_s), left=_minutes(LIFETIME_S - age_s))
        label.set_text(told if was_fresh else texts.EXPIRED)

    tell()
    ui.timer(1.0, tell)


def _minutes(seconds: float) -> str:
    return texts.MINUTES.format(minutes=int(seconds // 60), seconds=int(seconds % 60))


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
    columns = [f"{texts.SHARES_OF[what]}, {share.unit}" for what, share in shares.items()]
    rows = [
        (
            _named(source),
            *(_part(share, percent[source]) for share, percent in zip(shares.values(), together, strict=True)),
        )
        for source in SOURCES
    ]
    whole = (texts.SHARES_WHOLE, *(_part(share, 100.0) for share in shares.values()))
    return markup.joined(
        markup.heading(texts.SHARES_HEADING),
        markup.filled('<div aria-hidden="true">{}</div>', markup.joined(*map(_bar, together))),
        markup.table(
            (texts.SHARES_SOURCE, *columns),
            [*rows, whole],
            testid="shares",
            classes="shares",
            label=texts.SHARES_LABEL,
        ),
    )


def _target(tab: Tab) -> RobotTarget | None:
    """Return the robot's target for the plan shown; None before it is sent, and for another plan."""
    session, planning = tab.session.drilling.session, tab.planning
    shown = planning.sent_is_current and tab.known is planning.planned
    return session.target if session is not None and shown else None


def _together(share: Share) -> dict[str, float]:
    """Return percentages by source; the robot's sources are combined."""
    together = dict.fromkeys(SOURCES, 0.0)
    for source, percent in share.percent.items():
        together[source if source in SOURCES else "robot"] += percent
    return together


def _bar(percent: dict[str, float]) -> Markup:
    pieces = (
        markup.filled('<i style="width:{}%;background:{}"></i>', f"{of:.2f}", _colour(source))
        for source, of in percent.items()
    )
    return markup.filled('<div class="share">{}</div>', markup.joined(*pieces))


def _named(source: str) -> Markup:
    return markup.filled('<i style="background:{}"></i>{}', _colour(source), source.replace("_", " "))


def _part(share: Share, percent: float) -> Markup:
    """Return a source's contribution; squares of root mean squares add up."""
    own = share.rms * np.sqrt(percent / 100.0)
    return markup.filled("{}<small>{} %</small>", f"{own:.2f}", f"{percent:.0f}")


def _colour(source: str) -> str:
    return f"var(--{SOURCES[source]})"
