"""The page: steps along the top, two X-ray views, and the panel of the current step beside them."""

import json
from collections.abc import Callable
from functools import partial
from importlib.resources import files
from typing import Any

from markupsafe import Markup
from nicegui import ui

from sightline.app import texts
from sightline.app.drawing.pictures import Pictures
from sightline.app.panels import calibrate, drill, images, plan, verdict, verify
from sightline.app.panels.section import HtmlSection, PersistentSection, Section, action
from sightline.app.panels.space import Space
from sightline.app.panels.steps import steps
from sightline.app.session.session import Session
from sightline.app.settings import Settings
from sightline.app.tab.tab import Tab
from sightline.app.web.serve import ServedApp

_CSS, _SCRIPT = ((files("sightline.app") / name).read_text("utf-8") for name in ("page.css", "page.js"))
_PANELS: dict[str, Any] = dict(zip(texts.STEPS, (images, calibrate, plan, drill, verify), strict=True))


def build(site: ServedApp, session: Session, pictures: Pictures, settings: Settings) -> None:
    """Build the page for one browser tab."""
    ui.add_css(_CSS)
    ui.add_head_html(f"<script>{_SCRIPT}</script>")
    tab = Tab(session, pictures, fast_robot=settings.fast_robot, live_source=settings.live)
    with ui.element("header").classes("bar"):
        tools = _bar(tab)
    ui.label(texts.DEAD).classes("dead-banner").props("role=alert data-testid=dead")
    if site.reachable_from_outside:
        ui.label(texts.REACHABLE).classes("outside").props("role=alert data-testid=reachable")
    with ui.element("main").classes("work"):
        with ui.element("div").classes("sight"):
            Section(tab, lambda t: (t.message, _to_do(t)), _say, classes="say")
            with ui.splitter(value=50, limits=(20, 80)).classes("views") as both:
                both.props("data-testid=views")
                with both.before, ui.element("div").classes("view"):
                    first = ui.element("div").classes("fill")
                with both.after, ui.element("div").classes("view"):
                    second = ui.element("div").classes("fill")
                tab.build_views(first, second)
            space = Space(tab)
        with ui.element("aside").classes("panel"):
            images.build_drop_zone(tab, site)
            HtmlSection(tab, _beside_key(verdict.key), _html_on(verdict.html, 2, 3))
            Section(tab, _beside_key(verdict.age_key), _on(verdict.build_age, 2, 3))
            Section(tab, lambda t: t.step, lambda t: _PANELS[t.step].build(t), classes="step-panel")
            HtmlSection(tab, _beside_key(plan.metrics_key), _html_on(plan.metrics_html, 2), classes="figures")
            Section(tab, _beside_key(verdict.count), _on(verdict.build_details, 2, 3), classes="details")
            ui.label(f"{texts.NOT_A_DEVICE} Case {session.planning.case.number}").classes("foot")
    with tools:
        action("3-D", space.toggle, testid="space-toggle", kind="plain").move(tools, 0)
    ui.keyboard(on_key=lambda event: _key(tab, event), ignore=["input", "select", "textarea"])
    session.jobs.listeners.append(tab.later)
    ui.context.client.on_delete(lambda: session.jobs.listeners.remove(tab.later))
    leaving = _leave_question()
    ui.on("leave", leaving.open)
    request = ui.context.client.request
    asked = None if request is None else request.query_params.get("step")
    first = asked if asked in texts.STEPS else _first_open(session)
    tab.go_to(first)
    ui.run_javascript(f"sightlineStep(null, {json.dumps(first)})")
    tab.on_step = lambda *steps: ui.run_javascript(f"sightlineStep(...{json.dumps(steps)})") and None


def _leave_question() -> ui.dialog:
    """Return the dialog that asks for confirmation before a person leaves the page with the browser's back button."""
    with ui.dialog() as dialog, ui.card().classes("question"):
        ui.label(texts.LEAVE_QUESTION).classes("question-text").props("data-testid=leave-question")
        with ui.element("div").classes("choice"):
            action(texts.STAY, dialog.close, testid="leave-no", kind="primary")
            action(
                texts.LEAVE, lambda: ui.run_javascript("sightlineLeave()") and None, testid="leave-yes", kind="plain"
            )
    return dialog


def _first_open(session: Session) -> str:
    """Return the step to begin with: the first that is not done."""
    return next((step.name for step in steps(session) if step.status != "done"), texts.STEPS[-1])


def _bar(tab: Tab) -> ui.element:
    """Build brand, steps and tools; return the box of the tools."""
    ui.label("Sightline").classes("brand")
    PersistentSection(tab, lambda t: (steps(t.session), t.step), _steps, classes="steps")
    with ui.element("div").classes("tools") as tools:
        PersistentSection(
            tab, lambda t: (t.planning.history.can_undo, t.planning.history.can_redo), _undo, classes="undo"
        )
        Section(tab, lambda t: t.session.drilling.now is not None, _stop, classes="stop-box")
    return tools


def _steps(tab: Tab) -> Callable[[], None]:
    made: list[tuple[ui.button, ui.label, ui.tooltip]] = []
    for number, name in enumerate(texts.STEPS, 1):
        with action(f"{number} {name}", partial(tab.go_to, name), testid=f"step-{name}").classes("step") as button:
            made.append((button, ui.label().classes("standing"), ui.tooltip("").classes("step-reason")))

    def update() -> None:
        for step, (button, status, tip) in zip(steps(tab.session), made, strict=True):
            here = step.name == tab.step
            button.classes(f"{step.status} {'here' if here else ''}", remove=" ".join((*texts.STEP_STATUS, "here")))
            button.props(f"aria-current={'step' if here else 'false'}")
            status.set_text(texts.STEP_STATUS[step.status])
            tip.set_text(step.reason)

    return update


def _undo(tab: Tab) -> Callable[[], None]:
    undo = action("↶ Undo", tab.doing(tab.planning.undo), testid="undo", kind="plain")
    redo = action("↷ Redo", tab.doing(tab.planning.redo), testid="redo", kind="plain")

    def update() -> None:
        undo.set_enabled(tab.planning.history.can_undo)
        redo.set_enabled(tab.planning.history.can_redo)

    return update


def _stop(tab: Tab) -> None:
    if tab.session.drilling.session is not None:
        action("STOP", tab.doing(lambda: _stop_robot(tab)), testid="stop", kind="danger")
        ui.label(texts.RED_BUTTON).classes("red-button").props("data-testid=red-button")


async def _stop_robot(tab: Tab) -> None:
    session = tab.session.drilling.session
    if session is not None:
        await session.stop()


async def _key(tab: Tab, event) -> None:
    if not event.action.keydown or event.action.repeat:
        return
    name = str(event.key.name).lower()
    if event.modifiers.ctrl and name == "z":
        await tab.act(tab.planning.redo if event.modifiers.shift else tab.planning.undo)
    elif event.modifiers.ctrl and name == "y":
        await tab.act(tab.planning.redo)


def _say(tab: Tab) -> None:
    if tab.message:
        ui.label(tab.message).classes("message").props("role=alert data-testid=message")
    else:
        ui.label(_to_do(tab)).classes("instruction").props("role=status data-testid=instruction")


def _to_do(tab: Tab) -> str:
    """Return the next instruction: to place a point, or what the step waits for."""
    return plan.instruction(tab) or next(s.reason for s in steps(tab.session) if s.name == tab.step)


def _beside_key(key):
    return lambda tab: (tab.step, key(tab))


def _on(build: Callable[[Tab], None], *numbers: int) -> Callable[[Tab], None]:
    """Return a builder that builds only on the steps with these numbers."""

    def build_there(tab: Tab) -> None:
        if texts.STEPS.index(tab.step) in numbers:
            build(tab)

    return build_there


def _html_on(html: Callable[[Tab], Markup], *numbers: int) -> Callable[[Tab], Markup]:
    """Return the HTML on the steps with these numbers, else none."""
    return lambda tab: html(tab) if texts.STEPS.index(tab.step) in numbers else Markup()
