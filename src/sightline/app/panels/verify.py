"""The last step: the wire measured in two more images, beside its plan."""

from collections.abc import Hashable

import numpy as np

from sightline.app import texts
from sightline.app.panels.section import Section, action, checks, heading, note, table
from sightline.app.tab.tab import Tab
from sightline.app.texts import IMAGE_LABELS
from sightline.app.work.marks import CHECK_NAMES, asked_of


def _key(tab: Tab) -> Hashable:
    procedure = tab.procedure
    verifying = procedure.verifying
    return (
        *(procedure.seen(name) for name in CHECK_NAMES),
        verifying.shot,
        verifying.refused,
        procedure.drilling.wire,
        procedure.working,
        procedure.trouble,
        tab.goal,
        procedure.history.revision,
    )


def build(tab: Tab) -> None:
    """The panel."""
    Section(tab, _key, _check)


def _check(tab: Tab) -> None:
    procedure = tab.procedure
    heading(texts.CHECK_HEADING)
    if procedure.patient is not None:
        take = tab.doing(procedure.verifying.take_rehearsed)
        enabled = procedure.drilling.wire is not None and not procedure.working
        action(texts.TAKE_CHECK, take, testid="take-check", kind="primary", enabled=enabled)
        if procedure.drilling.wire is None:
            note(texts.DRILL_FIRST, kind="quiet")
    else:
        note(texts.DROP_CHECK, kind="quiet")
    if procedure.working:
        note(f"{procedure.working.capitalize()} …")
    if procedure.trouble:
        note(procedure.trouble, kind="bad")
    for name in CHECK_NAMES:
        seen = procedure.seen(name)
        if seen is not None:
            wire = name in procedure.verifying.wires
            state = seen.refused or (
                f"{seen.doing} …" if seen.doing else texts.WIRE_FOUND if wire else texts.CALIBRATED_ONLY
            )
            note(
                texts.CHECK_IMAGE.format(image=IMAGE_LABELS[name], state=state), kind="bad" if seen.refused else "good"
            )
    if all(procedure.seen(name) for name in CHECK_NAMES):
        _landmarks(tab)
    _result(tab)


def _landmarks(tab: Tab) -> None:
    """The same points of the bone, found again: they carry the plan over, should the bone have moved."""
    heading(texts.FOUND_AGAIN_HEADING)
    decisions = tab.procedure.decisions
    listed = tuple(asked for asked in asked_of(decisions.kind) if asked.group == "landmark")
    for asked in listed:
        planned = decisions.mark(asked.name).complete()
        point = asked.label if planned else texts.NOT_IN_PLAN.format(point=asked.label)
        placed = decisions.mark(asked.name).complete(CHECK_NAMES)
        note(f"{'●' if placed else '○'} {point}", kind="good" if placed else "quiet")

    action(texts.PLACE_LANDMARKS, lambda: tab.place(listed, CHECK_NAMES), testid="place-check")


def _result(tab: Tab) -> None:
    verifying = tab.procedure.verifying
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
