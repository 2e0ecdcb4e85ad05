"""The last step: the wire measured in two more images, beside its plan."""

from collections.abc import Hashable

import numpy as np

from sightline.app.marks import CHECK_NAMES, asked_of
from sightline.app.section import Section, action, checks, heading, note, table
from sightline.app.tab import Tab
from sightline.app.texts import IMAGE_LABELS


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
        tab.placing,
        procedure.history.revision,
    )


def build(tab: Tab) -> None:
    """The panel."""
    Section(tab, _key, _check)


def _check(tab: Tab) -> None:
    procedure = tab.procedure
    heading("Check shot")
    if procedure.patient is not None:
        take = tab.doing(procedure.verifying.take_rehearsed)
        enabled = procedure.drilling.wire is not None and not procedure.working
        action("Take both check images", take, testid="take-check", kind="primary", enabled=enabled)
        if procedure.drilling.wire is None:
            note("Drill the wire first.", kind="quiet")
    else:
        note("Drop both check images onto the page: PA and lateral, the frame where it was.", kind="quiet")
    if procedure.working:
        note(f"{procedure.working.capitalize()} …")
    if procedure.trouble:
        note(procedure.trouble, kind="bad")
    for name in CHECK_NAMES:
        seen = procedure.seen(name)
        if seen is not None:
            wire = name in procedure.verifying.wires
            state = seen.refused or (f"{seen.doing} …" if seen.doing else "wire found" if wire else "calibrated")
            note(f"{IMAGE_LABELS[name]}: {state}", kind="bad" if seen.refused else "good")
    if all(procedure.seen(name) for name in CHECK_NAMES):
        _landmarks(tab)
    _result(tab)


def _landmarks(tab: Tab) -> None:
    """The same points of the bone, found again: they carry the plan over, should the bone have moved."""
    heading("Landmarks, found again")
    decisions = tab.procedure.decisions
    listed = tuple(asked for asked in asked_of(decisions.kind) if asked.group == "landmark")
    for asked in listed:
        with_plan = "" if decisions.mark(asked.name).complete() else " (not in the plan)"
        placed = decisions.mark(asked.name).complete(CHECK_NAMES)
        note(f"{'●' if placed else '○'} {asked.label}{with_plan}", kind="good" if placed else "quiet")

    def place() -> None:
        tab.place_next(listed, CHECK_NAMES)
        tab.refresh()

    action("Place landmarks", place, testid="place-check")


def _result(tab: Tab) -> None:
    verifying = tab.procedure.verifying
    if verifying.refused:
        note(verifying.refused, kind="bad", testid="check-refused")
    shot = verifying.shot
    if shot is None:
        return
    heading("The wire against its plan")
    rows = [
        ("entry, across", f"{shot.entry_deviation_mm:.2f}", f"{shot.entry_error_95_mm:.2f}", "mm"),
        ("tip", f"{shot.tip_deviation_mm:.2f}", f"{shot.tip_error_95_mm:.2f}", "mm"),
        ("direction", f"{np.rad2deg(shot.angle_rad):.2f}", f"{np.rad2deg(shot.direction_error_95_rad):.2f}", "°"),
    ]
    table(("", "measured", "± 95 %", ""), rows, testid="deviation")
    note(f"The wire is bent by up to {shot.bow_mm:.2f} mm.", kind="quiet")
    note(
        "The check shot passed." if shot.passed else "The check shot did NOT pass.",
        kind="good" if shot.passed else "bad",
        testid="check-verdict",
    )
    checks(shot.checks, testid="check-checks")
