"""The one primary button at the end of each step: what comes next, at last the next step."""

from collections.abc import Hashable

from sightline.app import texts
from sightline.app.panels import drill, verify
from sightline.app.panels.section import Section, action
from sightline.app.panels.steps import steps
from sightline.app.tab.tab import Tab


def build(tab: Tab) -> None:
    """Build the button."""
    Section(tab, _key, _build, classes="lead")


def _key(tab: Tab) -> Hashable:
    of = {texts.STEPS[3]: drill.key, texts.STEPS[4]: verify.key}.get(tab.step)
    return tab.step, _done(tab), None if of is None else of(tab)


def _done(tab: Tab) -> bool:
    return next(step.status == "done" for step in steps(tab.session) if step.name == tab.step)


def _build(tab: Tab) -> None:
    number, done = texts.STEPS.index(tab.step), _done(tab)
    if number == 3 and not (done and tab.planning.sent_is_current):
        drill.build_next(tab)
    elif number == 4:
        verify.build_next(tab)
    else:
        after = texts.STEPS[number + 1]
        said = texts.CONTINUE_TO.format(step=after)
        action(said, lambda: tab.go_to(after), testid="continue", kind="primary", enabled=done)
