"""GO or NO-GO, in one place: every check, where the error comes from, how old the plan is, and what to do."""

from collections.abc import Hashable

import numpy as np
from nicegui import ui

from sightline.app.section import checks, heading, note
from sightline.app.tab import Tab
from sightline.checks import Check, failed
from sightline.errors import SightlineError
from sightline.planning.shares import error_shares, error_shares_of
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
    procedure, known = tab.procedure, tab.known
    return known, procedure.decisions.side, procedure.decisions.serial, procedure.go, procedure.drilling.session


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
    _shares(tab)
    with ui.element("details").props("data-testid=all-checks"):
        with ui.element("summary"):
            ui.label(f"All {len(listed)} checks")
        checks(listed, testid="verdict-checks")


def _age(tab: Tab) -> None:
    label = ui.label().classes("age").props("data-testid=age")

    def tell() -> None:
        age = tab.procedure.age_s
        if age is None:
            return
        left = LIFETIME_S - age
        gone = f"{int(age // 60)} min {int(age % 60):02d} s old"
        label.set_text(
            f"The images are {gone}; the plan expires in {int(left // 60)} min {int(left % 60):02d} s."
            if 0 <= age <= LIFETIME_S
            else "The plan has expired: take both images again (step Images)."
        )

    tell()
    ui.timer(1.0, tell)


def _shares(tab: Tab) -> None:
    """Where the error comes from, as bars."""
    known = tab.known
    assert known is not None and known.plan is not None  # noqa: S101
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
    with ui.element("div").classes("shares").props("data-testid=shares"):
        for what, share in shares.items():
            together: dict[str, float] = {}
            for source, percent in share.percent.items():
                name = source if source in _SOURCES else "robot"
                together[name] = together.get(name, 0.0) + percent
            ui.label({"entry": "entry", "end": "tip", "direction": "direction"}[what])
            with ui.element("div").classes("bar"):
                for source, percent in together.items():
                    piece = ui.element("div").style(f"width:{percent:.2f}%;background:{_SOURCES[source]}")
                    piece.props(f'title="{source.replace("_", " ")}: {percent:.0f} %"')
            ui.label(f"{share.rms:.2f} {share.unit}")
    with ui.element("div").classes("legend"):
        for source, colour in _SOURCES.items():
            ui.element("i").style(f"background:{colour}")
            ui.label(source.replace("_", " "))
