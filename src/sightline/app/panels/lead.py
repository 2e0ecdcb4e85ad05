"""The one primary button at the end of each step: what comes next, at last the next step."""

from collections.abc import Hashable

from sightline.app import texts
from sightline.app.panels import drill, verify
from sightline.app.panels.section import Section, action
from sightline.app.panels.steps import steps
from sightline.app.tab.step import ProcedureStep
from sightline.app.tab.tab import Tab


def build(tab: Tab) -> None:
    """Build the button."""
    Section(tab, _key, _build, classes="lead")


def _key(tab: Tab) -> Hashable:
    of = {ProcedureStep.DRILL: drill.key, ProcedureStep.VERIFY: verify.key}.get(tab.step)
    return tab.step, _done(tab), None if of is None else of(tab)


def _done(tab: Tab) -> bool:
    return next(one.status == "done" for one in steps(tab.session) if one.step is tab.step)


def _build(tab: Tab) -> None:
    done = _done(tab)
    if tab.step is ProcedureStep.DRILL and not (done and tab.planning.sent_is_current):
        drill.build_next(tab)
    elif tab.step is ProcedureStep.VERIFY:
        verify.build_next(tab)
    else:
        after = list(ProcedureStep)[tab.step.number]
        said = texts.CONTINUE_TO.format(step=texts.STEPS[after])
        action(said, lambda: tab.go_to(after), testid="continue", kind="primary", enabled=done)
