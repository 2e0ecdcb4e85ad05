"""The shot while drilling and the live image, in the step Drill: images, what was measured, what follows from it."""

from collections.abc import Hashable
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup
from nicegui import ui

from sightline.app import texts
from sightline.app.panels.section import Section, action, card, confirmed_action, heading, note, table
from sightline.app.session.sent import ZeroSource
from sightline.app.tab.placing import ProcedureStep
from sightline.app.tab.tab import Tab
from sightline.app.texts import image_label
from sightline.case.views import SHOT_NAMES
from sightline.case.watch.analyser import BLIND_TO
from sightline.common.checks import failed
from sightline.common.geometry.covariance import TWO_SIDED_95
from sightline.planning.check.result import MIN_LANDMARKS
from sightline.planning.check.shot import ALIGNED, NO_WIRE, PAUSED, TURNED_AWAY, DrillShot

if TYPE_CHECKING:
    from sightline.case.watch.analyser import Watched

_STATES = {"GO": "go", "STOP": "no-go", "INCOMPLETE": "incomplete"}  # of a card, by the decision


def key(tab: Tab) -> Hashable:
    """Key of the shot: the robot's state, the images, and the result."""
    shots, now = tab.session.shots, tab.session.drilling.now
    seen = tuple(tab.planning.seen(name) for name in SHOT_NAMES)
    robot = None if now is None or now.lost else (now.state, now.zero, now.activity)
    frame = shots.on_patient, shots.lacks_landmarks, shots.measuring, shots.objection
    return robot, shots.state, shots.shown, shots.found, shots.refused, seen, frame, tab.session.jobs.working


def verdict_html(tab: Tab) -> Markup:
    """Return the decision of the shot as HTML, in place of the plan's verdict; empty where no shot is taken."""
    shots = tab.session.shots
    if tab.step is not ProcedureStep.DRILL or not (shots.shown or shots.objection):
        return Markup()
    decision, sentence = _decided(tab)
    now = tab.session.drilling.now
    of = "" if now is None else texts.SHOT_HEADINGS[now.state]
    return card(_STATES[decision], decision, sentence, of, testid="shot-verdict")


def _decided(tab: Tab) -> tuple[str, str]:
    """Return the decision of the shot and the first reason, or what is missing before it can be measured."""
    shots = tab.session.shots
    if shots.found is not None:
        verdict = shots.found.verdict
        wrong = sorted(failed(verdict.checks), key=lambda check: check.missing)
        return shots.found.decision, texts.sentence(wrong[0]) if wrong else "The wire is on the plan. A person decides."
    if shots.objection:
        return "STOP", shots.objection
    for name in SHOT_NAMES:
        seen = tab.planning.seen(name)
        if seen is not None and (seen.refused or seen.doing):
            state = seen.refused or f"{seen.doing} …"
            return "INCOMPLETE", texts.CHECK_IMAGE.format(
                image=image_label(name, tab.planning.decisions.kind), state=state
            )
    if shots.lacks_landmarks:
        known = len(tab.planning.landmarks)
        return "INCOMPLETE", (
            f"Find {MIN_LANDMARKS} landmarks of the plan or more in both images; the plan has "
            f"{known}. They alone tell where a frame on the patient is."
        )
    return (
        "INCOMPLETE",
        texts.SHOT_MEASURING
        if shots.measuring
        else shots.refused or "Place the points that are asked for in both images.",
    )


def build(tab: Tab) -> None:
    """Build it where the robot waits for a shot."""
    now, shots = tab.session.drilling.now, tab.session.shots
    if now is None or now.lost or now.state not in (ALIGNED, PAUSED):
        return
    heading(texts.SHOT_HEADINGS[now.state])
    if tab.session.drilling.by_hand:
        note(NO_WIRE, kind="quiet", testid="no-wire")
        return
    if shots.on_patient:
        note("The frame is fixed to the patient, as a person stated.", kind="quiet", testid="on-patient")
    if not shots.state:
        note(TURNED_AWAY, kind="quiet", testid="turned-away")
    elif tab.planning.patient is None:
        note(
            "Drop both images of the shot onto the page, with the frame on the patient."
            if shots.on_patient
            else "Drop both images of the shot onto the page, with the block on its mount again.",
            kind="quiet",
        )
    else:
        enabled = not now.activity and not tab.session.jobs.working
        action("Take the shot", tab.doing(shots.take_rehearsed), testid="take-shot", kind="plain", enabled=enabled)
    if shots.found is not None:
        _measured(shots.found)
        if shots.shown == PAUSED and shots.found.decision == "GO" and ZeroSource.SHOT not in now.zero:
            action(
                "Send the measured depth", tab.doing(shots.send_depth), testid="send-measured", enabled=not now.activity
            )
    _frame_on_patient(tab)


def _frame_on_patient(tab: Tab) -> None:
    """Build the button for a person's statement where the frame is."""
    shots, now = tab.session.shots, tab.session.drilling.now
    fixed = not shots.on_patient
    confirmed_action(
        tab,
        texts.FRAME_IS_ON[fixed],
        texts.FRAME_ON_QUESTIONS[fixed],
        lambda: shots.state_on_patient(fixed=fixed),
        "frame-on-patient" if fixed else "frame-on-arm",
        enabled=now is not None and not now.activity,
        kind="plain",
    )


def _measured(shot: DrillShot) -> None:
    wire = shot.wire
    angle, error = np.rad2deg(wire.angle_rad), np.rad2deg(wire.direction_error_95_rad)
    rows = [
        ("entry, perpendicular", f"{wire.entry_deviation_mm:.2f} mm", f"{wire.entry_error_95_mm:.2f} mm"),
        ("end, drilled on", f"{np.linalg.norm(shot.end_mm):.2f} mm", f"{shot.end_error_95_mm:.2f} mm"),
        ("direction", f"{angle:.2f}°", f"{error:.2f}°"),
        ("depth of the tip", f"{shot.depth_mm:.2f} mm", f"{TWO_SIDED_95 * shot.depth_sd_mm:.2f} mm"),
    ]
    table(("", "measured", "± 95 %"), rows, testid="shot-measured")


_UPDATE_S = 0.1  # half of STALE_S; each update extends how long the browser shows the image as current


def build_live(tab: Tab) -> None:
    """Build this part of the panel."""
    heading("Live image")
    Section(tab, lambda t: t.session.live.watch is not None, _switch)
    state = ui.label().classes("note").props("data-testid=live-state role=status")
    note(BLIND_TO, kind="quiet")

    def update() -> None:
        watched = tab.session.live.latest()
        if watched is None:
            if tab.views.watched is not None:
                tab.show_live(None)
            watch = tab.session.live.watch
            state.set_text("" if watch is None else watch.fault or "Waiting for the first image …")
            return
        state.set_text(_live_sentence(watched))
        state.classes(add="bad" if watched.moved else "", remove="" if watched.moved else "bad")
        tab.show_live(watched)

    ui.timer(_UPDATE_S, update)


def _switch(tab: Tab) -> None:
    live = tab.session.live
    if live.watch is None:
        start = tab.doing(lambda: live.start(tab.live_source))
        action("Show the live image", start, testid="live-start", kind="plain")
        return

    async def stop() -> None:
        tab.show_live(None)
        await live.close()

    with ui.element("div").classes("choice"):
        action("End the live image", tab.doing(stop), testid="live-stop", kind="plain")
        action("I checked: nothing moved", tab.doing(live.watch.rest), testid="live-rest", kind="plain")


def _live_sentence(watched: "Watched") -> str:
    if watched.stale:
        return texts.STALE.format(age=watched.age_s)
    movement = watched.movement.text if watched.movement is not None else watched.note
    state = f"No view ({watched.reason})" if watched.view is None else "Calibrated"
    return f"{state}, {1000 * watched.latency_s:.0f} ms old. {movement}"
