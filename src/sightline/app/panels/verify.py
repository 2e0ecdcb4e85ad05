"""Step 5, Verify: the wire measured in two check images and compared with its plan."""

from collections.abc import Hashable

import numpy as np

from sightline.app import texts
from sightline.app.panels.section import Section, action, checks, heading, note, table
from sightline.app.plan.marks import CHECK_NAMES, marks_of
from sightline.app.tab.tab import Tab


def _key(tab: Tab) -> Hashable:
    planning, jobs, verifying = tab.planning, tab.session.jobs, tab.session.verifying
    return (
        *(planning.seen(name) for name in CHECK_NAMES),
        verifying.shot,
        verifying.refused,
        planning.drilled,
        jobs.working,
        jobs.trouble,
        tab.goal,
        planning.history.revision,
    )


def build(tab: Tab) -> None:
    """Build the panel."""
    Section(tab, _key, _check)


def _check(tab: Tab) -> None:
    planning, jobs, verifying = tab.planning, tab.session.jobs, tab.session.verifying
    heading(texts.CHECK_HEADING)
    if planning.patient is not None:
        take = tab.doing(verifying.take_rehearsed)
        enabled = planning.drilled is not None and not jobs.working
        action(texts.TAKE_CHECK, take, testid="take-check", kind="primary", enabled=enabled)
        if planning.drilled is None:
            note(texts.DRILL_FIRST, kind="quiet")
    else:
        note(texts.DROP_CHECK, kind="quiet")
    if jobs.working:
        note(f"{jobs.working.capitalize()} …")
    if jobs.trouble:
        note(jobs.trouble, kind="bad")
    for name in CHECK_NAMES:
        seen = planning.seen(name)
        if seen is not None:
            wire = name in verifying.wires
            state = seen.refused or (
                f"{seen.doing} …" if seen.doing else texts.WIRE_FOUND if wire else texts.CALIBRATED_ONLY
            )
            note(
                texts.CHECK_IMAGE.format(image=texts.IMAGE_LABELS[name], state=state),
                kind="bad" if seen.refused else "good",
            )
    if all(planning.seen(name) for name in CHECK_NAMES):
        _landmarks(tab)
    _result(tab)


def _landmarks(tab: Tab) -> None:
    """Build the list of landmarks found again: they transfer the plan if the bone has moved."""
    heading(texts.FOUND_AGAIN_HEADING)
    decisions = tab.planning.decisions
    listed = tuple(spec for spec in marks_of(decisions.kind) if spec.group == "landmark")
    for spec in listed:
        planned = decisions.mark(spec.name).complete()
        point = spec.label if planned else texts.NOT_IN_PLAN.format(point=spec.label)
        placed = decisions.mark(spec.name).complete(CHECK_NAMES)
        note(f"{'●' if placed else '○'} {point}", kind="good" if placed else "quiet")

    action(texts.PLACE_LANDMARKS, lambda: tab.place(listed, CHECK_NAMES), testid="place-check")


def _result(tab: Tab) -> None:
    verifying = tab.session.verifying
    if verifying.refused:
        note(verifying.refused, kind="bad", testid="check-refused")
    shot = verifying.shot
    if shot is None:
        return
    heading(texts.AGAINST_PLAN_HEADING)
    entry, tip, direction = texts.DEVIATIONS
    rows = [
        (entry, f"{shot.entry_deviation_mm:.2f}", f"{shot.entry_error_95_mm:.2f}", "mm"),
        (tip, f"{shot.tip_deviation_mm:.2f}", f"{shot.tip_error_95_mm:.2f}", "mm"),
        (direction, f"{np.rad2deg(shot.angle_rad):.2f}", f"{np.rad2deg(shot.direction_error_95_rad):.2f}", "°"),
    ]
    table(texts.DEVIATION_COLUMNS, rows, testid="deviation")
    note(texts.BENT.format(bow_mm=shot.bow_mm), kind="quiet")
    note(
        texts.CHECK_VERDICT[shot.passed],
        kind="good" if shot.passed else "bad",
        testid="check-verdict",
    )
    checks(shot.checks, testid="check-checks")
