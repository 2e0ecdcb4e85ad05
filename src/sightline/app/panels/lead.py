"""The one primary button at the end of each step: what comes next, at last the next step."""

from collections.abc import Hashable

from sightline.app import texts
from sightline.app.panels import drill, verify
from sightline.app.panels.section import Section, action
from sightline.app.panels.steps import StepStatus, steps
from sightline.app.plan.marks import MarkSpec
from sightline.app.tab.step import ProcedureStep
from sightline.app.tab.tab import Tab


def build(tab: Tab) -> None:
    """Build the button."""
    Section(tab, _key, _build, classes="lead")


def _key(tab: Tab) -> Hashable:
    of = {ProcedureStep.DRILL: drill.key, ProcedureStep.VERIFY: verify.key}.get(tab.step)
    return tab.step, _done(tab), _before(tab), _needed(tab), None if of is None else of(tab)


def _done(tab: Tab) -> bool:
    return next(one.status == "done" for one in steps(tab.session) if one.step is tab.step)


def _before(tab: Tab) -> ProcedureStep | None:
    """Return the step that a blocked one waits for."""
    listed = steps(tab.session)
    here = next(one for one in listed if one.step is tab.step)
    earlier = (one.step for one in listed if one.step.number < tab.step.number and one.status != StepStatus.DONE)
    return next(earlier, None) if here.status is StepStatus.BLOCKED else None


def _needed(tab: Tab) -> tuple[MarkSpec, ...]:
    """Return the clicks of an aid that the plan cannot be checked without, once all else is placed."""
    verdict = tab.session.readiness.verdict if tab.step is ProcedureStep.PLAN and tab.goal is None else None
    unmade = () if verdict is None else tuple(check.name for check in verdict.unmade)
    aids = (one for one in tab.planning.specs if one.group == "aid" and one.of in unmade)
    first = next(aids, None)
    return () if first is None else tuple(one for one in tab.planning.specs if one.of == first.of)


def _build(tab: Tab) -> None:
    done, before, needed = _done(tab), _before(tab), _needed(tab)
    waits = tab.step is ProcedureStep.DRILL and tab.planning.patient is not None and tab.session.drilling.now is None
    if before is not None and not waits:  # a robot can be started before the plan is GO
        said = texts.BACK_TO.format(step=texts.STEPS[before])
        action(said, lambda: tab.go_to(before), testid="back", kind="primary")
    elif needed:
        what = texts.word(needed[0].label.rsplit(" ", 1)[0])
        said = texts.PLACE_WHAT.format(what=what)
        action(said, lambda: tab.place(needed), testid="place-needed", kind="primary")
    elif tab.step is ProcedureStep.DRILL and not (done and tab.planning.sent_is_current):
        drill.build_next(tab)
    elif tab.step is ProcedureStep.VERIFY:
        verify.build_next(tab)
    else:
        after = list(ProcedureStep)[tab.step.number]
        said = texts.CONTINUE_TO.format(step=texts.STEPS[after])
        action(said, lambda: tab.go_to(after), testid="continue", kind="primary", enabled=done)
