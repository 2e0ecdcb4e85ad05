"""Step 4, Drill: send the plan, align the arm, drill the wire; a person confirms each motion."""

from collections.abc import Awaitable, Hashable
from functools import partial
from typing import TYPE_CHECKING

from markupsafe import Markup
from nicegui import ui

from sightline.app import texts
from sightline.app.panels import shots
from sightline.app.panels.section import (
    LIVE_S,
    Section,
    action,
    checks,
    confirmed_action,
    filled,
    heading,
    joined,
    note,
    put,
    table,
)
from sightline.app.panels.steps import build_next_wire, next_wire, waits_for
from sightline.app.session.planning import Planning
from sightline.app.session.sent import ZeroSource
from sightline.app.tab.placing import ProcedureStep
from sightline.app.tab.tab import Tab
from sightline.case.report.drilled import force_figure
from sightline.common.geometry.covariance import TWO_SIDED_95
from sightline.robot.contract import NO_SERIAL
from sightline.robot.control.states import State
from sightline.robot.kinematics.target import PLAN_SD_MM

if TYPE_CHECKING:
    from sightline.app.session.robot_session import RobotNow, RobotSession

_BEFORE_MM = 10.0  # the bar of the depth begins so far before its first mark, and ends so far behind its last [ours]
_DEPTH = (
    '<div class="depth" data-testid="depth"><div class="depth-value">{} <small>{}</small></div>'
    '<div class="depth-bar" aria-hidden="true"><i style="width:{}%"></i>{}</div><div class="depth-marks">{}</div></div>'
)
_PLOT_PX = 400.0  # about the panel's width, so that its text is as large as the panel's [ours]
_SHORT_MM = PLAN_SD_MM  # from here on a wire is short of its planned depth
_RETRACTABLE = tuple(state.value for state in (State.DONE, State.STOP, State.ALIGNED, State.PAUSED, State.GUIDE))


def key(tab: Tab) -> Hashable:
    """Key of the robot's state, of the plan that was sent, and of whether the current one may be."""
    now = tab.session.drilling.now
    robot = () if now is None else (now.state, now.fault, now.activity, now.last_error, now.lost, now.zero)
    planning, decisions = tab.planning, tab.planning.decisions
    plan = (planning.planned, decisions.side, decisions.serial, tab.session.readiness.can_send)
    held = (tab.session.drilling.held, tab.session.drilling.changed, decisions.kind)
    held = (*held, tab.session.shots.objection)
    return (robot, held, planning.drilled, planning.sent_is_current, plan, tab.session.jobs.working)


def _shot_key(tab: Tab) -> Hashable:
    # The plan is not part of the key: when it changes, the form is kept with the values typed into it.
    now = tab.session.drilling.now
    if now is None or now.lost:
        return None
    robot = (now.state == State.PAUSED.value, now.zero, now.activity, tab.session.drilling.changed)
    return (*robot, tab.session.shots.on_patient)


def build(tab: Tab) -> None:
    """Build the panel: the shot that the robot waits for, its state and depth, the second shot, the live image."""
    Section(tab, shots.key, shots.build)
    Section(tab, key, _robot)
    Section(tab, _shot_key, _second_shot)
    shots.build_live(tab)


def build_details(tab: Tab) -> None:
    """Build the details: the checks of the robot's target, and the thrust over depth."""
    Section(tab, key, _target)
    Section(tab, lambda t: t.session.drilling.session, _force)


def _target(tab: Tab) -> None:
    session = tab.session.drilling.session
    if session is not None and session.target is not None:
        heading("The plan in the robot")
        checks(session.target.checks, testid="target-checks")


def _robot(tab: Tab) -> None:
    """Build the state of the robot, what to know of the next motion, and motions besides it."""
    planning, now = tab.planning, tab.session.drilling.now
    heading("Robot")
    if now is None or now.lost:
        _unlinked(tab)
    else:
        _state(tab)
        session = tab.session.drilling.session
        if now.fault:
            note(f"Fault {now.fault}: {now.text}", kind="bad", testid="fault")
        elif not tab.session.readiness.can_send and planning.drilled is None:
            note(texts.ONLY_GO, kind="warn", testid="not-go")
        if now.open_hole_mm is not None and planning.drilled is None:
            again = "the robot drills on there, and stops if it meets bone before"
            note(
                f"This hole was drilled to {now.open_hole_mm:.1f} mm before: {again}.", kind="warn", testid="open-hole"
            )
        if tab.session.drilling.changed:
            note(tab.session.drilling.changed, kind="bad", testid="changed-after-sending")
        if session is not None and now.state in _RETRACTABLE:
            confirmed_action(
                tab,
                "Retract",
                texts.GUIDE_BACK if tab.session.drilling.by_hand else texts.RETRACT,
                session.retract,
                "retract",
                enabled=not now.activity,
                kind="plain",
            )
    if planning.drilled is not None:
        note(how_deep(planning), kind="good", testid="drilled")
    note(texts.STOP_IS_NO_EMERGENCY_STOP, kind="warn")


def _unlinked(tab: Tab) -> None:
    """Build what is said without a robot, and its start where another button leads on."""
    planning, now = tab.planning, tab.session.drilling.now
    if now is not None:
        note(now.last_error, kind="bad", testid="robot-said")
    if planning.patient is None:
        note(texts.NO_ROBOT, kind="warn", testid="no-robot")
    elif tab.session.jobs.working:
        note(texts.in_progress(tab.session.jobs.working))
    else:
        if now is None:
            note("The robot is not started.", kind="quiet")
        to_retract = planning.drilled is not None and planning.sent_is_current
        if to_retract or waits_for(tab.session, ProcedureStep.DRILL) is not None:  # the plan comes first
            _start(tab, "plain")


def how_deep(planning: Planning) -> str:
    """Return how deep the wire was drilled, as text: a drill that is to pass a far cortex stops behind it."""
    assert planning.drilled is not None  # noqa: S101
    assert planning.sent is not None  # noqa: S101 - what is drilled was sent
    plan, told_mm = planning.sent.plan, planning.drilled.record.depth_mm
    planned_mm = plan.trajectory.length_mm + plan.kind.limits.beyond_mm
    if not len(told_mm):
        return texts.DRILLED_BY_HAND
    short = planned_mm - float(told_mm.max())
    return (
        "Drilled to the planned depth. Verify the wire in two check images."
        if short < _SHORT_MM
        else (
            f"Drilled through the far cortex, {short:.1f} mm short of the planned depth. Verify "
            "the wire in two check images."
        )
    )


def _state(tab: Tab) -> None:
    now = tab.session.drilling.now
    assert now is not None  # noqa: S101
    with ui.element("div").classes("robot-state").props(f"data-testid=robot-state data-state={now.phase} role=status"):
        ui.label(texts.STATES.get(now.phase, texts.STATE_UNKNOWN)).classes("state-word")
    if now.last_error:
        note(now.last_error, kind="bad", testid="robot-said")
    bar = put(_depth(tab))
    readings = ui.label().classes("note quiet").props("data-testid=robot-live")

    def tell() -> None:
        at = tab.session.drilling.now
        if at is not None:
            bar.set_content(_depth(tab))
            readings.set_text(reading(at))
            tab.show_views()  # the wire fills along the plan

    tell()
    ui.timer(LIVE_S, tell)


def _depth(tab: Tab) -> Markup:
    """Return the depth as HTML: its value, and a bar with cortex, pause, planned tip and limit."""
    # Imported here so that the first page does not wait for it.
    from sightline.robot.control.supervision import EventKind
    from sightline.robot.kinematics.target import pause_depth

    session, now = tab.session.drilling.session, tab.session.drilling.now
    if session is None or now is None or session.target is None or session.depth_limit_mm is None:
        return Markup()
    if tab.session.drilling.by_hand:  # it knows no depth
        return Markup()
    end = session.target.depth_mm
    touched = next((event.depth_mm for event in session.record.events if event.name == EventKind.CORTEX.value), 0.0)
    pause = pause_depth(end, session.target.limits)
    at = dict(zip(("cortex", "pause", "tip", "limit"), (touched, pause, end, session.depth_limit_mm), strict=True))
    low, high = min(touched, pause) - _BEFORE_MM, session.depth_limit_mm + _BEFORE_MM

    def percent(depth_mm: float) -> str:
        return f"{100 * min(max((depth_mm - low) / (high - low), 0.0), 1.0):.1f}"

    ticks = (filled('<b style="left:{}%">{}</b>', percent(mm), name[:1].upper()) for name, mm in at.items())
    rows = (
        filled("<div><b>{}</b> {} <span>{} mm</span></div>", name[:1].upper(), name, texts.unsigned(f"{mm:.1f}"))
        for name, mm in at.items()
    )
    depth = now.depth_mm
    return filled(
        _DEPTH,
        "–" if depth is None else f"{abs(depth):.1f} mm",
        "" if depth is None else "before the entry" if depth < 0.0 else "beyond the entry",
        percent(low if depth is None else depth),
        joined(*ticks),
        joined(*rows),
    )


def reading(now: "RobotNow") -> str:
    """Return the 95 % error of the depth with the source of its zero, and the thrust, as text."""
    depth = "–" if now.depth_mm is None else f"{_error_words(now)} (zero: {_zero_words(now)})"
    force = "–" if now.force_n is None else f"{max(now.force_n, 0.0):.1f} N"
    return f"Depth {depth} · thrust {force}"


def _error_words(now: "RobotNow") -> str:
    return "± ?" if now.depth_sd_mm is None else f"± {TWO_SIDED_95 * now.depth_sd_mm:.1f} mm"


def _zero_words(now: "RobotNow") -> str:
    *others, last = (texts.ZEROS[source] for source in now.zero)
    return texts.DISPLAY_AND.join([", ".join(others), last] if others else [last])


def build_next(tab: Tab) -> None:
    """Build the one button for what comes next; each motion needs a person's confirmation."""
    planning, drilling = tab.planning, tab.session.drilling
    session, now = drilling.session, drilling.now
    if planning.patient is None:  # a person's own images, without a robot
        save = tab.doing(tab.save_report)
        made = planning.planned is not None and planning.planned.plan is not None
        action(texts.REPORT, save, testid="save-report", kind="primary", enabled=made)
        return
    if now is None or now.lost or session is None:
        _start(tab, "primary")
        return
    idle, state = not now.activity, now.state
    held = drilling.held is not None and not drilling.changed
    left = _left_mm(session)
    ready = idle and held and not tab.session.shots.objection
    if now.fault:
        confirmed_action(
            tab,
            "Reset the fault",
            "Have you checked the robot and dealt with the fault?",
            lambda: session.reset(now.fault),
            "reset-fault",
            enabled=idle,
        )
    elif state == State.ALIGNED.value:
        drill = partial(drilling.drill, State.ALIGNED)
        by_hand = drilling.by_hand
        question = texts.HOLD_QUESTION if by_hand else texts.DRILL_QUESTION.format(left=left)
        confirmed_action(tab, texts.HOLD if by_hand else texts.DRILL, question, drill, "drill", enabled=ready)
    elif state == State.PAUSED.value:
        drill = partial(drilling.drill, State.PAUSED)
        question = f"Continue drilling: the last {left:.0f} mm. Does the second shot show the wire on the plan?"
        confirmed_action(tab, texts.DRILL_ON, question, drill, "drill-on", enabled=ready)
    elif planning.drilled is not None and next_wire(tab) is not None:
        build_next_wire(tab)
    elif state in (State.TARGETING.value, State.STOP.value) and held:
        confirmed_action(
            tab,
            texts.ALIGN,
            texts.ALIGN_GUIDE_QUESTION if drilling.by_hand else texts.ALIGN_QUESTION,
            drilling.align,
            "align",
            enabled=ready,
        )
    else:
        _send(tab, enabled=idle and state not in (State.DONE.value, State.GUIDE.value))


def _left_mm(session: "RobotSession | None") -> float:
    """Return the length that is drilled after the pause, mm; 0 without a plan in the robot."""
    from sightline.robot.kinematics.target import pause_depth

    target = None if session is None else session.target
    return 0.0 if target is None else target.depth_mm - pause_depth(target.depth_mm, target.limits)


def _start(tab: Tab, kind: str) -> None:
    jobs, drilling = tab.session.jobs, tab.session.drilling

    def begin() -> Awaitable[None]:
        return jobs.during("starting the simulated robot", lambda: drilling.start_robot(fast=tab.fast_robot))

    enabled = tab.planning.patient is not None and not jobs.working
    action("Start the simulated robot", tab.doing(begin), testid="start-robot", kind=kind, enabled=enabled)


def _send(tab: Tab, *, enabled: bool) -> None:
    planning, drilling = tab.planning, tab.session.drilling
    known, side, serial = planning.planned, planning.decisions.side, planning.decisions.serial
    if known is None or known.plan is None or side is None or not tab.session.readiness.can_send:
        action(texts.SEND, lambda: None, testid="send", kind="primary", enabled=False)
        return
    what = (
        f"The {'robot' if planning.patient is None else 'simulated robot'} receives a wire of "
        f"{known.plan.trajectory.length_mm:.1f} mm on the {side} side, in "
        f"the coordinates of {'the frame without a serial' if serial == NO_SERIAL else f'frame {serial}'}. "
        "Nothing moves yet. “Align” will then move the arm until the wire's guide points "
        "along the plan, 20 mm before the bone."
    )
    confirmed_action(
        tab,
        texts.SEND,
        "Send this plan to the robot?",
        lambda: drilling.send(known),
        "send",
        what=what,
        enabled=enabled,
    )


def _second_shot(tab: Tab) -> None:
    """Build the form for the depth measured in the second shot, during the pause."""
    drilling, now = tab.session.drilling, tab.session.drilling.now
    measured = tab.planning.frame.solid is not None or tab.session.shots.on_patient
    if now is None or now.lost or now.state != State.PAUSED.value or measured:
        return
    enabled = not now.activity and drilling.held is not None and not drilling.changed
    rests_on = f"rests on the {_zero_words(now)}, {_error_words(now)}."
    heading("Depth in the second shot")
    if ZeroSource.SHOT in now.zero:
        note(f"The depth of the second shot was sent. The depth now {rests_on}", kind="good", testid="shot-told")
        return
    note(
        "If you measured the tip's depth beyond the planned entry point in the second shot, enter it here. Sightline "
        "does not measure this shot, because the frame has moved away with the arm. Without it the depth " + rests_on,
        testid="shot-unmeasured",
    )
    depth = ui.number("Depth of the tip, mm", format="%.2f").props("outlined dense data-testid=shot-depth")
    error = ui.number("Its 95 % error, ± mm", format="%.2f").props("outlined dense data-testid=shot-error")

    def tell() -> Awaitable[None]:
        return drilling.send_shot_depth(
            *(float("nan" if field.value is None else field.value) for field in (depth, error))
        )

    question = (
        f"Send this depth to the robot? It counts the last {_left_mm(drilling.session):.0f} "
        "mm from it. A depth can be sent only once."
    )
    confirmed_action(tab, "Send the depth", question, tell, "tell-shot", enabled=enabled, kind="plain")


def _force(tab: Tab) -> None:
    """Build the live plot of thrust over depth."""
    if tab.session.drilling.session is None and tab.planning.drilled is None:
        return
    heading("Thrust over depth")
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
                ("event", "depth", "thrust"),
                [
                    (
                        event.name,
                        f"{texts.unsigned(f'{event.depth_mm:.1f}')} mm",
                        f"{texts.unsigned(f'{event.force_n:.1f}')} N",
                    )
                    for event in record.events
                ],
                testid="events-table",
            )

    tell()
    ui.timer(LIVE_S * 2, tell)
