"""The top row: the five steps, the next instruction, the time left, undo and redo, STOP with the state of its link; and
the one primary button at the end of each step."""

from collections.abc import Callable, Hashable
from functools import partial

from markupsafe import Markup
from nicegui import ui

from sightline.app import texts
from sightline.app.panels import drill, plan, verify
from sightline.app.panels.section import LONG, LONGER, HtmlSection, PersistentSection, Section, action, filled
from sightline.app.panels.steps import build_missing_wire, missing_wires, needed_aids, steps, waits_for
from sightline.app.plan.marks import MarkSpec, label_of
from sightline.app.tab.placing import ProcedureStep
from sightline.app.tab.tab import Tab
from sightline.robot.kinematics.target import LIFETIME_S

_EXPIRING_S = 120.0  # [ours] time left that is marked: long enough to drill one wire, or to take another image


def build(tab: Tab) -> None:
    """Build the row."""
    with ui.element("div").classes("guide"):
        with ui.element("nav").props('aria-label="Steps" data-went=0') as nav:
            PersistentSection(tab, lambda t: (steps(t.session), t.step), _steps, classes="steps")
        with ui.element("div").classes("say"):
            with ui.element("div").props("role=status"):
                HtmlSection(tab, _said, _say, drag=False)
            Section(tab, lambda t: t.optional, _skip)
    ui.on("step", lambda event: _follow(tab, nav, event.args))
    with ui.element("div").classes("tools"):
        _time(tab)
        history = tab.planning.history
        PersistentSection(tab, lambda _: (history.can_undo, history.can_redo), _undo, classes="undo")
        PersistentSection(tab, _link, _stop, classes="stop-box")


def _follow(tab: Tab, nav: ui.element, place: object) -> None:
    """Go to the step of the browser's history; `place`: the step, and how often the history was used (page.js)."""
    match place:
        case [str(step), int(went)] if step in list(ProcedureStep):
            nav.props(f"data-went={went}")
            tab.go_to(ProcedureStep(step))
        case _:
            pass


def _steps(tab: Tab) -> Callable[[], None]:
    made: list[tuple[ui.button, ui.label, ui.tooltip]] = []
    for step in ProcedureStep:
        text = f"{step.number} {texts.STEPS[step]}"
        with action(text, partial(tab.go_to, step), testid=f"step-{step}").classes("step") as button:
            made.append((button, ui.label().classes("unseen"), ui.tooltip("").classes("step-reason")))

    def update() -> None:
        for each, (button, status, tip) in zip(steps(tab.session), made, strict=True):
            here = each.step is tab.step
            button.classes(f"{each.status} {'here' if here else ''}", remove=" ".join((*texts.STEP_STATUS, "here")))
            button.props(f"aria-current={'step' if here else 'false'}")
            status.set_text(texts.STEP_STATUS[each.status])
            tip.set_text(f"{texts.STEP_STATUS[each.status]}: {each.reason}")

    return update


def _said(tab: Tab) -> Hashable:
    return tab.message, tab.notices, tab.is_good, tab.goal, tab.progress, None if tab.goal else _reason(tab)


def _say(tab: Tab) -> Markup:
    """Return the message, or else the next instruction: to place a point, or what the step waits for."""
    if tab.message:
        return filled(
            '<div class="message {} {}" role="alert" data-testid="message">{}</div>',
            "good" if tab.is_good else "",
            size_of(tab.message),
            tab.message,
        )
    instruction = plan.instruction(tab)
    if instruction is None:
        return filled(
            '<div class="instruction {}" data-testid="instruction">{}</div>', size_of(_reason(tab)), _reason(tab)
        )
    counter, image, what = instruction
    return filled(
        '<div class="instruction {}" data-testid="instruction"><span class="counter">{}</span> · '
        '<span class="in-image">{}</span> · {}</div>',
        size_of(counter + image + what),
        counter,
        image,
        what,
    )


def _skip(tab: Tab) -> None:
    """Build the button that passes over a point that the plan can do without; nothing for another one."""
    if tab.optional is not None:
        action(texts.SKIP, tab.skip, testid="skip", kind="small").props(f'title="{texts.SKIP_TITLE}"')


def size_of(text: str) -> str:
    """Return the class of an instruction by its length."""
    return "longer" if len(text) > LONGER else "long" if len(text) > LONG else ""


def _reason(tab: Tab) -> str:
    return next(each.reason for each in steps(tab.session) if each.step is tab.step)


def _time(tab: Tab) -> None:
    """Build the time that the plan is valid; it says why GO ends when it has expired."""
    box = ui.element("div").classes("time").props("data-testid=age")
    with box:
        word, under = ui.label().classes("time-word"), ui.label().classes("time-under")
        tip = ui.tooltip("")
    age, was_fresh = tab.session.age, tab.session.age.fresh

    def tell() -> None:
        nonlocal was_fresh
        now_s, drilled_s, fresh = age.now_s, age.drilled_s, age.fresh
        left = 0.0 if now_s is None else LIFETIME_S - now_s
        state = "unknown" if now_s is None else "done" if drilled_s is not None else "left" if fresh else "expired"
        word.set_text({"left": _minutes(left), "done": "✓", "expired": _minutes(0.0)}.get(state, "–"))
        under.set_text(texts.TIME_UNDER[state])
        text = texts.TIME_TOLD[state].format(age=_minutes(now_s or 0.0), sent=_minutes(drilled_s or 0.0))
        tip.set_text(text)
        marked = state == "expired" or (state == "left" and left < _EXPIRING_S)
        box.classes(add="short" if marked else "", remove="" if marked else "short")
        if fresh != was_fresh:
            was_fresh = fresh
            tab.later()  # GO must not be shown for a plan that has expired

    tell()
    ui.timer(1.0, tell)
    tab.on_refresh.append(tell)


def _minutes(seconds: float) -> str:
    return f"{int(seconds // 60)}:{int(seconds % 60):02d}"


def _undo(tab: Tab) -> Callable[[], None]:
    made = [
        action(sign, tab.doing(what), testid=testid, kind="plain").props(f'aria-label="{name}" title="{title}"')
        for sign, testid, name, title, what in (
            ("↶", "undo", "Undo", "Undo (Ctrl+Z)", tab.planning.undo),
            ("↷", "redo", "Redo", "Redo (Ctrl+Y)", tab.planning.redo),
        )
    ]

    def update() -> None:
        for button, on in zip(made, (tab.planning.history.can_undo, tab.planning.history.can_redo), strict=True):
            button.set_enabled(on)

    return update


def _link(tab: Tab) -> bool | None:
    now = tab.session.drilling.now
    return None if now is None else now.lost


def _stop(tab: Tab) -> Callable[[], None]:
    button = action("STOP", tab.doing(lambda: _stop_robot(tab)), testid="stop", kind="danger")
    button.props(f'title="{texts.STOP_IS_NO_EMERGENCY_STOP}"')
    state = ui.label().classes("link").props("data-testid=link role=status")
    ui.label("use the red button").classes("red-button").props("data-testid=red-button")

    def update() -> None:
        lost = _link(tab)
        button.set_enabled(lost is not None)  # of a lost link it says what to do
        name = {None: "none", True: "lost", False: "open"}[lost]
        state.set_text(texts.LINKS[name])
        state.classes(name, remove=" ".join(texts.LINKS))

    return update


async def _stop_robot(tab: Tab) -> None:
    session = tab.session.drilling.session
    if session is not None:
        await session.stop()


def build_lead(tab: Tab) -> None:
    """Build the button."""
    Section(tab, _lead_key, _lead, classes="lead")


def _lead_key(tab: Tab) -> Hashable:
    of = {ProcedureStep.DRILL: drill.key, ProcedureStep.VERIFY: verify.key}.get(tab.step)
    steps_on = (tab.step, _done(tab), waits_for(tab.session, tab.step), _needed(tab), _missing_wires(tab))
    return (*steps_on, None if of is None else of(tab))


def _done(tab: Tab) -> bool:
    return next(each.status == "done" for each in steps(tab.session) if each.step is tab.step)


def _missing_wires(tab: Tab) -> tuple[str, ...]:
    """Return the wires that are not placed, once all else that is asked for is."""
    return missing_wires(tab.planning) if tab.step is ProcedureStep.PLAN and tab.goal is None else ()


def _needed(tab: Tab) -> tuple[MarkSpec, ...]:
    """Return the clicks of an aid that the plan cannot be checked without, once all else is placed."""
    verdict = tab.session.readiness.verdict if tab.step is ProcedureStep.PLAN and tab.goal is None else None
    known = tab.planning.planned
    aids = () if verdict is None or known is None else needed_aids(known, verdict)
    return tuple(spec for spec in tab.planning.specs if spec.of in aids[:1])


def _lead(tab: Tab) -> None:
    done, before, needed = _done(tab), waits_for(tab.session, tab.step), _needed(tab)
    if before is not None:
        text = f"Back to {texts.STEPS[before]}"
        action(text, lambda: tab.go_to(before), testid="back", kind="primary")
    elif _missing_wires(tab):
        build_missing_wire(tab)
    elif needed:
        label = label_of(needed)
        text = texts.PLACE_WHAT.format(what=label[:1].lower() + label[1:])
        action(text, lambda: tab.place(needed), testid="place-needed", kind="primary")
    elif tab.step is ProcedureStep.DRILL and not (done and tab.planning.sent_is_current):
        drill.build_next(tab)
    elif tab.step is ProcedureStep.VERIFY:
        verify.build_next(tab)
    else:
        after = list(ProcedureStep)[tab.step.number]
        text = f"Continue to {texts.STEPS[after]}"
        action(text, lambda: tab.go_to(after), testid="continue", kind="primary", enabled=done)
