"""Step 4, Drill: send the plan, align the arm, drill the wire; a person confirms each motion."""

from collections.abc import Awaitable, Callable, Hashable
from typing import TYPE_CHECKING

from nicegui import ui

from sightline.app import texts
from sightline.app.panels import live
from sightline.app.panels.section import Section, action, checks, heading, note, table
from sightline.app.tab.tab import Tab
from sightline.case.report.drilled import force_figure
from sightline.geometry.covariance import TWO_SIDED_95
from sightline.robot.control.states import State

if TYPE_CHECKING:
    from sightline.app.session.robot_session import RobotNow

_PLOT_PX = 400.0  # about the panel's width, so that its text is as large as the panel's [ours]
_LIVE_S = 0.2  # update period of the robot's readings [ours]


def _key(tab: Tab) -> Hashable:
    now = tab.session.drilling.now
    told = () if now is None else (now.state, now.fault, now.activity, now.last_error, now.lost, now.zero)
    planning, decisions = tab.planning, tab.planning.decisions
    plan = (planning.planned, decisions.side, decisions.serial, tab.session.readiness.can_send)
    return (told, planning.sent, planning.drilled, planning.sent_is_current, plan, tab.session.jobs.working)


def _shot_key(tab: Tab) -> Hashable:
    # The plan is not part of the key: when it changes, the form is kept with the values typed into it.
    now = tab.session.drilling.now
    if now is None:
        return None
    return (now.state == State.PAUSED.value, now.zero, now.activity, tab.planning.sent_is_current)


def build(tab: Tab) -> None:
    """Build the panel."""
    Section(tab, _key, _robot)
    Section(tab, _shot_key, _second_shot)
    live.build(tab)
    Section(tab, lambda t: t.session.drilling.session, _force)


def _robot(tab: Tab) -> None:
    drilling, jobs = tab.session.drilling, tab.session.jobs
    now = drilling.now
    heading(texts.ROBOT_HEADING)
    note(texts.STOP_IS_NO_EMERGENCY_STOP, kind="warn")
    if now is None or now.lost:
        if now is not None:
            note(now.last_error, kind="bad", testid="robot-said")
        if tab.planning.patient is None:
            note(texts.NO_ROBOT, kind="warn", testid="no-robot")
            return

        def begin() -> Awaitable[None]:
            return jobs.during(texts.STARTING_ROBOT, lambda: drilling.start_robot(fast=tab.fast_robot))

        busy = bool(jobs.working)
        action(texts.START_ROBOT, tab.doing(begin), testid="start-robot", kind="primary", enabled=not busy)
        if busy:
            note(f"{jobs.working.capitalize()} …")
        return
    _state(tab)
    if drilling.session is not None and drilling.session.target is not None:
        checks(drilling.session.target.checks, testid="target-checks")
    _commands(tab)


def _state(tab: Tab) -> None:
    now = tab.session.drilling.now
    assert now is not None  # noqa: S101
    with ui.element("div").classes("robot-state").props("data-testid=robot-state role=status"):
        ui.label(now.state).classes("state-word")
        ui.label(f"{now.activity} …" if now.activity else "").classes("state-doing")
    if now.last_error:
        note(now.last_error, kind="bad", testid="robot-said")
    reading = ui.label().classes("live").props("data-testid=robot-live")

    def tell() -> None:
        at = tab.session.drilling.now
        if at is None:
            return
        force = "–" if at.force_n is None else f"{at.force_n:.1f} N"
        reading.set_text(f"depth {depth_words(at)} · thrust {force}")

    tell()
    ui.timer(_LIVE_S, tell)


def depth_words(now: "RobotNow") -> str:
    """Return the depth with its 95 % error and the source of its zero, as text."""
    if now.depth_mm is None:
        return "–"
    return f"{now.depth_mm:.1f} mm {_error_words(now)} (zero: {_zero_words(now)})"


def _error_words(now: "RobotNow") -> str:
    return "± ?" if now.depth_sd_mm is None else f"± {TWO_SIDED_95 * now.depth_sd_mm:.1f} mm"


def _zero_words(now: "RobotNow") -> str:
    return " and ".join([", ".join(now.zero[:-1]), now.zero[-1]] if now.zero[1:] else now.zero)


def _commands(tab: Tab) -> None:
    """Build the buttons for the possible commands; each motion needs a person's confirmation."""
    planning, drilling = tab.planning, tab.session.drilling
    session, now = drilling.session, drilling.now
    assert now is not None and session is not None  # noqa: S101
    idle, state = not now.activity, now.state
    if now.fault:
        note(texts.FAULT.format(number=now.fault, what=now.text), kind="bad", testid="fault")
        _confirmed_action(
            tab, texts.RESET_FAULT, texts.RESET_QUESTION, lambda: session.reset(now.fault), "reset-fault", enabled=idle
        )
        return
    known, decisions = planning.planned, planning.decisions
    can_send = tab.session.readiness.can_send
    if known is not None and known.plan is not None and can_send and decisions.side is not None:
        what = texts.SEND_WHAT.format(
            robot=texts.ROBOT_NAMES[planning.patient is not None],
            length=known.plan.trajectory.length_mm,
            side=decisions.side,
            serial=decisions.serial,
        )
        enabled = idle and state not in (State.ALIGNED.value, State.PAUSED.value, State.DONE.value)
        _confirmed_action(
            tab, texts.SEND, texts.SEND_QUESTION, lambda: drilling.send(known), "send", what=what, enabled=enabled
        )
    else:
        note(texts.ONLY_GO, kind="warn", testid="not-go")
    ready = idle and session.target is not None and planning.sent_is_current
    if session.target is not None and not planning.sent_is_current:
        note(texts.CHANGED_AFTER_SENDING, kind="bad", testid="changed-after-sending")
    if state in (State.TARGETING.value, State.STOP.value):
        _confirmed_action(tab, texts.ALIGN, texts.ALIGN_QUESTION, drilling.align, "align", enabled=ready)
    if state == State.ALIGNED.value:
        _confirmed_action(
            tab, texts.DRILL, texts.DRILL_QUESTION, lambda: drilling.drill(State.ALIGNED), "drill", enabled=ready
        )
    if state == State.PAUSED.value:
        _confirmed_action(
            tab,
            texts.DRILL_ON,
            texts.DRILL_ON_QUESTION,
            lambda: drilling.drill(State.PAUSED),
            "drill-on",
            enabled=ready,
        )
    if state in (State.DONE.value, State.STOP.value, State.ALIGNED.value, State.PAUSED.value):
        _confirmed_action(
            tab, texts.RETRACT, texts.RETRACT_QUESTION, session.retract, "retract", enabled=idle, kind="plain"
        )
    if state == State.DONE.value or planning.drilled is not None:
        note(texts.DRILLED, kind="good", testid="drilled")


def _second_shot(tab: Tab) -> None:
    """Build the form for the depth measured in the second shot, during the pause."""
    drilling, now = tab.session.drilling, tab.session.drilling.now
    if now is None or now.state != State.PAUSED.value:
        return
    enabled = not now.activity and tab.planning.sent_is_current
    known = {"zero": _zero_words(now), "error": _error_words(now)}
    heading(texts.SHOT_HEADING)
    if texts.BY_SHOT in now.zero:
        note(texts.SHOT_TOLD.format(**known), kind="good", testid="shot-told")
        return
    note(texts.SHOT_UNMEASURED.format(**known), testid="shot-unmeasured")
    depth = ui.number(texts.SHOT_DEPTH, format="%.2f").props("outlined dense data-testid=shot-depth")
    error = ui.number(texts.SHOT_ERROR, format="%.2f").props("outlined dense data-testid=shot-error")

    def tell() -> Awaitable[None]:
        return drilling.send_shot_depth(*(float("nan" if one.value is None else one.value) for one in (depth, error)))

    _confirmed_action(tab, texts.SEND_DEPTH, texts.SHOT_QUESTION, tell, "tell-shot", enabled=enabled, kind="plain")


def _confirmed_action(
    tab: Tab,
    text: str,
    question: str,
    command: Callable[[], Awaitable[object]],
    testid: str,
    *,
    what: str = "",
    enabled: bool,
    kind: str = "primary",
) -> None:
    """Build a button that asks for confirmation before it acts."""
    with ui.dialog() as dialog, ui.card().classes("question"):
        ui.label(question).classes("question-text")
        if what:
            ui.label(what)

        async def agreed() -> None:
            dialog.close()
            await tab.act(command)

        with ui.element("div").classes("choice"):
            action(texts.CANCEL, dialog.close, testid=f"{testid}-cancel", kind="plain")
            action(text, agreed, testid=f"{testid}-yes", kind="primary")
    action(text, dialog.open, testid=testid, kind=kind, enabled=enabled)


def _force(tab: Tab) -> None:
    """Build the live plot of thrust over depth."""
    if tab.session.drilling.session is None and tab.planning.drilled is None:
        return
    heading(texts.THRUST_HEADING)
    drawing = ui.html("", sanitize=False).classes("force").props("data-testid=force")
    events = ui.column().classes("events").props("data-testid=events")
    shown = -1

    def tell() -> None:
        nonlocal shown
        session, drilled = tab.session.drilling.session, tab.planning.drilled
        if drilled is not None:
            record = drilled.record
        else:
            record = None if session is None else session.record
        if record is None or len(record.depth_mm) == shown:
            return
        shown = len(record.depth_mm)
        picture = force_figure(record, _PLOT_PX)
        drawing.set_content(picture)
        events.clear()
        if not picture:
            return  # no samples of this plan yet
        with events:
            table(
                texts.EVENT_COLUMNS,
                [(one.name, f"{one.depth_mm:.1f} mm", f"{one.force_n:.1f} N") for one in record.events],
                testid="events-table",
            )

    tell()
    ui.timer(_LIVE_S * 2, tell)
