"""The one primary button at the end of each step: what comes next, at last the next step."""

from collections.abc import Hashable

from sightline.app import texts
from sightline.app.panels import drill, verify
from sightline.app.panels.needed import needed_aids
from sightline.app.panels.section import Section, action
from sightline.app.panels.steps import steps, waits_for
from sightline.app.plan.marks import MarkSpec
from sightline.app.tab.step import ProcedureStep
from sightline.app.tab.tab import Tab


def build(tab: Tab) -> None:
    """Build the button."""
    Section(tab, _key, _build, classes="lead")


def _key(tab: Tab) -> Hashable:
    of = {ProcedureStep.DRILL: drill.key, ProcedureStep.VERIFY: verify.key}.get(tab.step)
    return tab.step, _done(tab), waits_for(tab.session, tab.step), _needed(tab), None if of is None else of(tab)


def _done(tab: Tab) -> bool:
    return next(one.status == "done" for one in steps(tab.session) if one.step is tab.step)


def _needed(tab: Tab) -> tuple[MarkSpec, ...]:
    """Return the clicks of an aid that the plan cannot be checked without, once all else is placed."""
    verdict = tab.session.readiness.verdict if tab.step is ProcedureStep.PLAN and tab.goal is None else None
    known = tab.planning.planned
    aids = () if verdict is None or known is None else needed_aids(known, verdict)
    return tuple(one for one in tab.planning.specs if one.of in aids[:1])


def _build(tab: Tab) -> None:
    done, before, needed = _done(tab), waits_for(tab.session, tab.step), _needed(tab)
    if before is not None:
        said = f"Back to {texts.STEPS[before]}"
        action(said, lambda: tab.go_to(before), testid="back", kind="primary")
    elif needed:
        label = needed[0].label if len(needed) == 1 else needed[0].label.rsplit(" ", 1)[0]
        said = texts.PLACE_WHAT.format(what=label[:1].lower() + label[1:])
        action(said, lambda: tab.place(needed), testid="place-needed", kind="primary")
    elif tab.step is ProcedureStep.DRILL and not (done and tab.planning.sent_is_current):
        drill.build_next(tab)
    elif tab.step is ProcedureStep.VERIFY:
        verify.build_next(tab)
    else:
        after = list(ProcedureStep)[tab.step.number]
        said = texts.CONTINUE_TO.format(step=texts.STEPS[after])
        action(said, lambda: tab.go_to(after), testid="continue", kind="primary", enabled=done)
