"""GO or NO-GO, in one place: every check, where the error comes from, how old the plan is, and what to do."""

from collections.abc import Hashable

import numpy as np
from markupsafe import Markup
from nicegui import ui

from sightline.app import texts
from sightline.app.section import Section, checks, heading, markup, note, table
from sightline.app.tab import Tab
from sightline.checks import Check, failed
from sightline.errors import SightlineError
from sightline.planning.shares import Share, error_shares, error_shares_of
from sightline.robot.target import LIFETIME_S

SOURCES = {  # of error, and the colour of each (colours.js)
    "beads": "sky",
    "map": "green",
    "focal_point": "yellow",
    "frame": "orange",
    "picks": "purple",
    "robot": "vermillion",
}


def key(tab: Tab) -> Hashable:
    """What the verdict shows."""
    listed = _listed(tab)
    return len(listed), tuple(check.sentence for check in failed(listed))


def count(tab: Tab) -> Hashable:
    """How many checks there are."""
    return len(_listed(tab))


def details_key(tab: Tab) -> Hashable:
    """What the details show."""
    procedure, known = tab.procedure, tab.known
    return (
        known,
        procedure.fresh,
        procedure.decisions.side,
        procedure.decisions.serial,
        procedure.go,
        procedure.drilling.session,
    )


def _listed(tab: Tab) -> tuple[Check, ...]:
    """Every check of the plan that is shown; none where there is no plan."""
    known = tab.known
    return () if known is None or known.plan is None else (*known.plan.verdict.checks, *tab.procedure.confirmations)


def build(tab: Tab) -> None:
    """The verdict, and what to do about each check that failed."""
    listed = _listed(tab)
    if not listed:
        return
    go = all(check.passed for check in listed)
    with ui.element("div").classes(f"verdict {'go' if go else 'no-go'}").props("data-testid=verdict role=status"):
        ui.label(texts.GO[go]).classes("verdict-word")
        wrong = failed(listed)
        told = texts.ALL_PASSED if go else texts.SOME_FAILED.format(failed=len(wrong), all=len(listed))
        ui.label(told).classes("verdict-sentence")
    _age(tab)
    for check in failed(listed):
        note(check.sentence, kind="bad", testid="do-about")


def build_details(tab: Tab) -> None:
    """Where the error comes from, and every check with figure and limit."""
    listed = _listed(tab)
    if not listed:
        return
    Section(tab, details_key, _shares)
    with ui.element("details").props("data-testid=all-checks"):
        with ui.element("summary"):
            ui.label(texts.ALL_CHECKS.format(count=len(listed)))
        Section(tab, details_key, lambda t: checks(_listed(t), testid="verdict-checks"))


def _age(tab: Tab) -> None:
    label = ui.label().classes("age").props("data-testid=age")
    was_fresh = tab.procedure.fresh

    def tell() -> None:
        age = tab.procedure.age_s
        if age is None:
            return
        if tab.procedure.fresh != was_fresh:
            tab.refresh()  # GO must not stand over a plan that has expired
            return
        told = texts.EXPIRES.format(age=_minutes(age), left=_minutes(LIFETIME_S - age))
        label.set_text(told if was_fresh else texts.EXPIRED)

    tell()
    ui.timer(1.0, tell)


def _minutes(seconds: float) -> str:
    return texts.MINUTES.format(minutes=int(seconds // 60), seconds=int(seconds % 60))


def _shares(tab: Tab) -> None:
    """Where the error comes from: a table, and bars for who sees their colours."""
    known = tab.known
    if known is None or known.plan is None:
        return
    try:
        target = tab.procedure.drilling.session and tab.procedure.drilling.session.target
        if target:
            ends = np.stack([target.entry_mm, target.end_mm])
            shares = error_shares_of(ends, target.budget_mm2)
        else:
            shares = error_shares(known.plan.trajectory)
    except SightlineError:
        return
    heading(texts.SHARES_HEADING)
    together = [_together(share) for share in shares.values()]
    bars = (f'<div class="share">{_pieces(percent)}</div>' for percent in together)
    markup("".join(bars), "div").props("aria-hidden=true")
    columns = [f"{texts.SHARES_OF[what]}, {share.unit}" for what, share in shares.items()]
    rows = [
        (
            _named(source),
            *(_part(share, percent[source]) for share, percent in zip(shares.values(), together, strict=True)),
        )
        for source in SOURCES
    ]
    whole = (texts.SHARES_WHOLE, *(_part(share, 100.0) for share in shares.values()))
    shown = table((texts.SHARES_SOURCE, *columns), [*rows, whole], testid="shares")
    shown.classes("shares").props(f'aria-label="{texts.SHARES_LABEL}"')


def _together(share: Share) -> dict[str, float]:
    """Percent by source; all that the robot adds is one."""
    together = dict.fromkeys(SOURCES, 0.0)
    for source, percent in share.percent.items():
        together[source if source in SOURCES else "robot"] += percent
    return together


def _pieces(percent: dict[str, float]) -> str:
    return "".join(f'<i style="width:{of:.2f}%;background:{_colour(source)}"></i>' for source, of in percent.items())


def _named(source: str) -> Markup:
    return Markup('<i style="background:{}"></i>{}').format(_colour(source), source.replace("_", " "))


def _part(share: Share, percent: float) -> Markup:
    """What a source adds: squares of root mean squares add up."""
    return Markup("{:.2f}<small>{:.0f} %</small>").format(share.rms * np.sqrt(percent / 100.0), percent)


def _colour(source: str) -> str:
    return f"var(--{SOURCES[source]})"
