"""The page: the instruction along the top, two X-ray views, and the column of the current step beside them."""

from collections.abc import Callable
from importlib.resources import files

from markupsafe import Markup
from nicegui import ui

from sightline.app import texts
from sightline.app.panels import bone, drill, images, plan, shots, top, verdict, verify
from sightline.app.panels.drawer import Drawer, Menu, OpenCase
from sightline.app.panels.section import HtmlSection, Section, action
from sightline.app.panels.space import Space
from sightline.app.panels.steps import build_wires, steps
from sightline.app.tab.placing import ProcedureStep
from sightline.app.tab.tab import Tab
from sightline.app.web.serve import ServedApp

_CSS, _SCRIPT = ((files("sightline.app") / name).read_text("utf-8") for name in ("page.css", "page.js"))
_PANELS: dict[ProcedureStep, Callable[[Tab], None]] = dict(
    zip(ProcedureStep, (images.build, images.build_calibration, plan.build, drill.build, verify.build), strict=True)
)


def build(site: ServedApp, tab: Tab, open_case: OpenCase) -> None:
    """Build the page for one browser tab. `open_case`: shows another case on all pages."""
    ui.add_css(_CSS)
    ui.add_head_html(f"<script>{_SCRIPT}</script>")
    with ui.element("header").classes("top"):
        top.build(tab)
    ui.label(
        "Use the red button: the program does not respond. STOP does not reach the robot, "
        "and this page may be out of date."
    ).classes("dead-banner").props("role=alert data-testid=dead")
    if site.reachable_from_outside:
        ui.label("Other machines can reach this page; anyone with its address and token can move the robot.").classes(
            "outside"
        ).props("role=alert data-testid=reachable")
    with ui.element("div").classes("work"):
        with ui.element("div").classes("sight"):  # Quasar's page is the main landmark
            ui.html("<h1>Sightline: planning and drilling of a wire</h1>", sanitize=False).classes("unseen")
            with ui.element("div").classes("views").props("data-testid=views"):
                boxes = [ui.element("div").classes("view") for _ in range(2)]
                tab.build_views(*boxes)
                images.build_side(tab)
            menu = Menu(tab, open_case)
            space, drawer = Space(tab), Drawer(tab, menu)
        with ui.element("aside").classes("panel").props('aria-label="Verdict, figures and what to do"'):
            _panel(tab, site, boxes, drawer, space)
    ui.keyboard(on_key=lambda event: _key(tab, menu, event), ignore=["input", "select", "textarea"])
    tab.session.jobs.listeners.append(tab.later)
    ui.context.client.on_delete(lambda: tab.session.jobs.forget(tab.later))
    leaving = _leave_question()
    ui.on("leave", leaving.open)
    request = ui.context.client.request
    asked = None if request is None else request.query_params.get("step")
    first = (
        ProcedureStep(asked)
        if asked in list(ProcedureStep)
        else next((each.step for each in steps(tab.session) if each.status != "done"), ProcedureStep.VERIFY)
    )
    tab.go_to(first)


def _panel(tab: Tab, site: ServedApp, boxes: list[ui.element], drawer: Drawer, space: Space) -> None:
    """Build the column: verdict and figures, the step's own part, and the button that leads on."""
    build_wires(tab)
    with ui.element("div").props("role=status"):
        HtmlSection(
            tab,
            lambda t: (_planning(t), t.step, verdict.key(t), shots.key(t)),
            lambda t: shots.verdict_html(t) or verdict.html(t) if _planning(t) else Markup(),
        )
    HtmlSection(
        tab,
        lambda t: (t.step, t.known, t.planning.decisions.kind),
        lambda t: verdict.figures_html(t) if t.step is ProcedureStep.PLAN else Markup(),
        classes="figures",
    )
    with ui.element("div").classes("step-box"):
        images.build_drop_zone(tab, site, boxes)
        Section(tab, lambda t: t.step, lambda t: _PANELS[t.step](t), classes="step-panel")
        bone.build(tab, site)
    with ui.element("div").classes("feet"):
        action(texts.DETAILS, drawer.toggle, testid="details", kind="plain small")
        action("3-D", space.toggle, testid="space-toggle", kind="plain small")
        top.build_lead(tab)


def _planning(tab: Tab) -> bool:
    return tab.step in (ProcedureStep.PLAN, ProcedureStep.DRILL)


def _leave_question() -> ui.dialog:
    """Return the dialog that asks for confirmation before a person leaves the page with the browser's back button."""
    with ui.dialog().props('aria-label="Leave this page?"') as dialog, ui.card().classes("question"):
        ui.label("Leave this page? The plan stays in the case, but STOP is not available without the page.").classes(
            "question-text"
        ).props("data-testid=leave-question")
        with ui.element("div").classes("choice"):
            action("Stay", dialog.close, testid="leave-no", kind="primary")
            action("Leave", lambda: ui.run_javascript("sightlineLeave()") and None, testid="leave-yes", kind="plain")
    return dialog


async def _key(tab: Tab, menu: Menu, event) -> None:
    if not event.action.keydown or event.action.repeat:
        return
    name = str(event.key.name).lower()
    if name == "?":
        menu.show_shortcuts()
    if event.modifiers.ctrl and name == "z":
        await tab.act(tab.planning.redo if event.modifiers.shift else tab.planning.undo)
    elif event.modifiers.ctrl and name == "y":
        await tab.act(tab.planning.redo)
