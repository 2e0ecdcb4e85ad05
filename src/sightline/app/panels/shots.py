"""The shot while drilling, in the step Drill: its images, what it measured, and what follows from it."""

from collections.abc import Hashable

import numpy as np

from sightline.app import texts
from sightline.app.panels import markup
from sightline.app.panels.section import action, heading, note, put, table
from sightline.app.plan.marks import SHOT_NAMES
from sightline.app.session.zero import ZeroSource
from sightline.app.tab.tab import Tab
from sightline.geometry.covariance import TWO_SIDED_95
from sightline.planning.drill_shot import ALIGNED, PAUSED, TURNED_AWAY, DrillShot

_STATES = {"GO": "go", "STOP": "no-go", "INCOMPLETE": "incomplete"}  # of a card, by the decision
_CARD = (
    '<div class="verdict {}" data-testid="shot-verdict"><div class="verdict-word">{}</div>'
    '<div class="verdict-sentence"{}>{}</div></div>'
)


def key(tab: Tab) -> Hashable:
    """Key of the shot: the robot's state, the images, and the result."""
    shots, now = tab.session.shots, tab.session.drilling.now
    seen = tuple(tab.planning.seen(name) for name in SHOT_NAMES)
    told = None if now is None else (now.state, now.zero, now.activity)
    return told, shots.state, shots.shown, shots.found, shots.refused, seen, tab.session.jobs.working


def build(tab: Tab) -> None:
    """Build it where the robot waits for a shot."""
    now, shots = tab.session.drilling.now, tab.session.shots
    if now is None or now.lost or now.state not in (ALIGNED, PAUSED):
        return
    heading(texts.SHOT_HEADINGS[now.state])
    if tab.planning.frame.solid is None:
        note(TURNED_AWAY, kind="quiet", testid="turned-away")
        return
    if tab.planning.patient is None:
        note(texts.SHOT_DROP, kind="quiet")
    else:
        enabled = not now.activity and not tab.session.jobs.working
        action(texts.TAKE_SHOT, tab.doing(shots.take_rehearsed), testid="take-shot", kind="plain", enabled=enabled)
    if not shots.shown:
        return
    for name in SHOT_NAMES:
        seen = tab.planning.seen(name)
        if seen is not None and (seen.refused or seen.doing):
            state = seen.refused or f"{texts.word(seen.doing)} …"
            note(
                texts.CHECK_IMAGE.format(image=texts.IMAGE_LABELS[name], state=state),
                kind="bad" if seen.refused else "",
            )
    if shots.refused:
        note(shots.refused, kind="bad", testid="shot-refused")
    if shots.found is not None:
        _result(shots.found)
        if shots.shown == PAUSED and shots.found.decision == "GO" and ZeroSource.SHOT not in now.zero:
            action(texts.SEND_MEASURED, tab.doing(shots.send_depth), testid="send-measured", enabled=not now.activity)


def _result(found: DrillShot) -> None:
    wrong = [texts.said(one) for one in found.verdict.checks if not one.passed]
    told = wrong[0] if wrong else texts.SHOT_ON_PLAN if found.decision == "GO" else ""
    put(markup.filled(_CARD, _STATES[found.decision], texts.SHOT_DECISIONS[found.decision], markup.lang(told), told))
    wire, (entry, end, direction, depth) = found.wire, texts.SHOT_ROWS
    angle, error = np.rad2deg(wire.angle_rad), np.rad2deg(wire.direction_error_95_rad)
    rows = [
        (entry, f"{wire.entry_deviation_mm:.2f} mm", f"{wire.entry_error_95_mm:.2f}"),
        (end, f"{np.linalg.norm(found.end_mm):.2f} mm", f"{found.end_error_95_mm:.2f}"),
        (direction, f"{angle:.2f}°", f"{error:.2f}"),
        (depth, f"{found.depth_mm:.2f} mm", f"{TWO_SIDED_95 * found.depth_sd_mm:.2f}"),
    ]
    table(texts.SHOT_COLUMNS, rows, testid="shot-measured")
