"""The verdict, GO or NO-GO: all checks, the error budget, the plan's age, and what to do."""

from collections.abc import Hashable

import numpy as np
from markupsafe import Markup

from sightline.app import texts
from sightline.app.panels import markup
from sightline.app.panels.needed import aid_labels, needed_aids
from sightline.app.panels.section import HtmlSection
from sightline.app.panels.steps import refusals
from sightline.app.tab.tab import Tab
from sightline.app.tab.view_names import with_view_named
from sightline.checks import Check, failed
from sightline.errors import SightlineError
from sightline.planning.points.error_shares import Share, error_shares, error_shares_of
from sightline.robot.kinematics.target import RobotTarget

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
    return len(listed), tuple(check.sentence for check in failed(listed)), left(tab), _refused(tab), lacking


def left(tab: Tab) -> tuple[str, ...]:
    """Return what is left to do before a verdict: points to place, what a person must confirm, and aids to draw."""
    decisions, known, verdict = tab.planning.decisions, tab.planning.planned, tab.session.readiness.verdict
    if known is None:
        return ("two calibrated images",)
    asked = [spec for spec in tab.planning.asked if not decisions.complete([spec.name])]
    confirmed = (("patient's side", decisions.side), ("frame's serial", decisions.serial))
    aids = () if verdict is None else needed_aids(known, verdict)
    return (
        *(spec.label for spec in asked),
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


def html(tab: Tab) -> Markup:
    """Return the verdict as HTML: of a plan that is NO-GO the first thing to do, of an incomplete one what is left, or
    what the patient does not have."""
    if lacking := tab.planning.lacking:
        state, (told, _) = "incomplete", texts.LACKS[lacking]
        return markup.card(state, texts.VERDICTS[state], told, "", testid="verdict")
    verdict, missing = tab.session.readiness.verdict_of(tab.known), left(tab)
    state = "incomplete" if verdict is None else verdict.state
    if verdict is None or state == "incomplete":
        unmade = () if verdict is None else tuple(dict.fromkeys(verdict.missing))
        refused = _refused(tab)
        left_said = () if not missing else (texts.LEFT.format(what=", ".join(missing)),)
        told, *others = refused or left_said or unmade or ("",)
        more = len(others)
    else:
        kind = tab.planning.decisions.kind
        wrong = [with_view_named(check, kind) for check in failed(verdict.checks) if not check.missing]
        told, more = (texts.sentence(wrong[0]) if wrong else "Every check passed. A person decides."), len(wrong) - 1
    said = texts.MORE.format(count=more) if more > 0 else ""
    return markup.card(state, texts.VERDICTS[state], told, said, testid="verdict")


def build_details(tab: Tab) -> None:
    """Build the error budget and the list of all checks with value and limit."""
    HtmlSection(tab, details_key, _all_checks)
    HtmlSection(tab, details_key, _shares)


def _all_checks(tab: Tab) -> Markup:
    kind = tab.planning.decisions.kind
    listed = [with_view_named(check, kind) for check in _listed(tab)]
    if not listed:
        return Markup()
    return markup.joined(markup.heading(f"All {len(listed)} checks"), markup.checks(listed, testid="verdict-checks"))


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
            _named(source),
            *(
                "–" if source in unknown else _part(share, percent[source])
                for share, percent in zip(shares.values(), together, strict=True)
            ),
        )
        for source in SOURCES
    ]
    whole = ("together", *(_part(share, 100.0) for share in shares.values()))
    return markup.joined(
        markup.heading("Where the error comes from"),
        markup.filled('<div aria-hidden="true">{}</div>', markup.joined(*map(_bar, together))),
        markup.table(
            ("source", *columns),
            [*rows, whole],
            testid="shares",
            classes="shares",
            label="Root mean square of each source, and its share of the mean square",
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
