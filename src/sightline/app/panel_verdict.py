"""GO or NO-GO, in one place: every check, where the error comes from, how old the plan is, and what to do."""

from collections.abc import Hashable

import numpy as np
from nicegui import ui

from sightline.app.section import Section, checks, heading, markup, note
from sightline.app.tab import Tab
from sightline.checks import Check, failed
from sightline.errors import SightlineError
from sightline.planning.shares import Share, error_shares, error_shares_of
from sightline.robot.target import LIFETIME_S

_SOURCES = {
    "beads": "#56b4e9",
    "map": "#009e73",
    "focal_point": "#f0e442",
    "frame": "#e69f00",
    "picks": "#cc79a7",
    "robot": "#d55e00",
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
        ui.label("GO" if go else "NO-GO").classes("verdict-word")
        wrong = failed(listed)
        ui.label(
            "Every check passed. A person decides." if go else f"{len(wrong)} of {len(listed)} checks failed."
        ).classes("verdict-sentence")
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
            ui.label(f"All {len(listed)} checks")
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
        left = LIFETIME_S - age
        gone = f"{int(age // 60)} min {int(age % 60):02d} s old"
        label.set_text(
            f"The images are {gone}; the plan expires in {int(left // 60)} min {int(left % 60):02d} s."
            if was_fresh
            else "The plan has expired: take both images again (step Images)."
        )

    tell()
    ui.timer(1.0, tell)


def _shares(tab: Tab) -> None:
    """Where the error comes from, as bars."""
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
    heading("Where the error comes from")
    markup("".join(map(_bar, shares, shares.values())), "div").classes("shares").props("data-testid=shares")
    legend = (f'<i style="background:{colour}"></i><div>{_words(source)}</div>' for source, colour in _SOURCES.items())
    markup("".join(legend), "div").classes("legend")


def _bar(what: str, share: Share) -> str:
    together: dict[str, float] = {}
    for source, percent in share.percent.items():
        name = source if source in _SOURCES else "robot"
        together[name] = together.get(name, 0.0) + percent
    pieces = (
        f'<div style="width:{percent:.2f}%;background:{_SOURCES[name]}" title="{_words(name)}: {percent:.0f} %"></div>'
        for name, percent in together.items()
    )
    label = {"entry": "entry", "end": "tip", "direction": "direction"}[what]
    return f'<div>{label}</div><div class="bar">{"".join(pieces)}</div><div>{share.rms:.2f} {share.unit}</div>'


def _words(source: str) -> str:
    return source.replace("_", " ")
