"""Step 5, Verify: the wire measured in two check images and compared with its plan."""

from collections.abc import Hashable
from functools import partial

import numpy as np

from sightline.app import texts
from sightline.app.panels.section import Section, action, card, checks, heading, note, put, table
from sightline.app.panels.steps import build_next_wire, missing_again, next_wire
from sightline.app.tab.tab import Tab
from sightline.app.texts import image_label
from sightline.case.views import CHECK_NAMES
from sightline.common.checks import failed


def key(tab: Tab) -> Hashable:
    """Key of the check shot: its images, its result, and the landmarks found again."""
    planning, jobs, verifying = tab.planning, tab.session.jobs, tab.session.verifying
    return (
        *(planning.seen(name) for name in CHECK_NAMES),
        *verifying.shots.values(),
        verifying.refused,
        planning.decisions.kind,
        *planning.all_drilled.values(),
        jobs.working,
        jobs.trouble,
        tab.goal,
        planning.history.revision,
    )


def build(tab: Tab) -> None:
    """Build the panel."""
    Section(tab, key, _check)


def build_details(tab: Tab) -> None:
    """Build the details: the checks of the check shot."""
    Section(tab, lambda t: (t.session.verifying.shot, *t.session.verifying.shots.values()), _checks)


def _checks(tab: Tab) -> None:
    shot = tab.session.verifying.shot
    if shot is not None:
        heading("Wire compared with the plan")
        note(f"The wire is bent by up to {shot.bow_mm:.2f} mm.", kind="quiet")
        checks(shot.checks, testid="check-checks")
    if relations := tab.session.verifying.relations():
        heading("The wires to each other")
        checks(relations, testid="relation-checks")


def build_next(tab: Tab) -> None:
    """Build the one button for what comes next: the check images, their landmarks."""
    planning, jobs, verifying = tab.planning, tab.session.jobs, tab.session.verifying
    if planning.patient is not None and not verifying.shows_all:
        take = tab.doing(verifying.take_rehearsed)
        enabled = bool(planning.all_drilled) and not jobs.working
        action("Take both check images", take, testid="take-check", kind="primary", enabled=enabled)
    elif all(planning.seen(name) for name in CHECK_NAMES) and missing_again(tab.planning):
        place = partial(tab.place, planning.landmarks, CHECK_NAMES)
        action("Place landmarks", place, testid="place-check", kind="primary")
    elif verifying.shot is not None and verifying.shot.passed and next_wire(tab) is not None:
        build_next_wire(tab)
    else:
        save = tab.doing(tab.save_report)
        action(texts.REPORT, save, testid="save-report", kind="primary", enabled=verifying.shot is not None)


def _check(tab: Tab) -> None:
    planning, jobs, verifying = tab.planning, tab.session.jobs, tab.session.verifying
    _result(tab)
    heading("Check shot")
    if not planning.all_drilled and planning.patient is not None:
        note("Drill the wire first.", kind="quiet")
    elif planning.patient is None:
        note("Drop both check images onto the page, with the frame in the same place.", kind="quiet")
    if jobs.working:
        note(texts.in_progress(jobs.working))
    if jobs.trouble:
        note(jobs.trouble, kind="bad")
    for name in CHECK_NAMES:
        seen = planning.seen(name)
        if seen is not None:
            wire = name in verifying.wires
            state = seen.refused or (f"{seen.doing} …" if seen.doing else "wire found" if wire else "calibrated")
            note(
                texts.CHECK_IMAGE.format(image=image_label(name, planning.decisions.kind), state=state),
                kind="bad" if seen.refused else "good",
            )
    if all(planning.seen(name) for name in CHECK_NAMES):
        _landmarks(tab)


def _landmarks(tab: Tab) -> None:
    """Build the list of landmarks found again: they transfer the plan if the bone has moved."""
    heading("Landmarks, found again")
    decisions = tab.planning.decisions
    listed = tuple(spec for spec in decisions.specs if spec.group == "landmark")
    for spec in listed:
        planned = decisions.mark(spec.name).complete()
        label = spec.label
        point = label if planned else f"{label} (not in the plan)"
        placed = decisions.mark(spec.name).complete(CHECK_NAMES)
        note(point if placed else f"○ {point}", kind="good" if placed else "quiet")


def _result(tab: Tab) -> None:
    verifying = tab.session.verifying
    if verifying.refused:
        note(verifying.refused, kind="bad", testid="check-refused")
    shot = verifying.shot
    if shot is None:
        return
    wrong, missing = failed(shot.checks), missing_again(tab.planning)
    if wrong and missing:
        text = texts.LEFT.format(what=", ".join(missing))
        put(card("incomplete", texts.VERDICTS["incomplete"], text, testid="check-verdict"))
    else:
        word, sentence = texts.CHECK_VERDICT[shot.passed]
        text = texts.sentence(wrong[0]) if wrong else sentence
        more = (
            texts.MORE.format(count=len(wrong) - 1)
            if wrong[1:]
            else "Judged at both holes of the nail, and by how far the tip lies beyond the far one."
            if shot.at_holes
            else ""
        )
        put(card("go" if shot.passed else "no-go", word, text, more, testid="check-verdict"))
    tip = "tip, not judged" if shot.at_holes else "tip"
    rows = [
        ("entry, perpendicular", f"{shot.entry_deviation_mm:.2f} mm", f"{shot.entry_error_95_mm:.2f} mm"),
        (tip, f"{shot.tip_deviation_mm:.2f} mm", f"{shot.tip_error_95_mm:.2f} mm"),
        ("direction", f"{np.rad2deg(shot.angle_rad):.2f}°", f"{np.rad2deg(shot.direction_error_95_rad):.2f}°"),
    ]
    table(("", "measured", "± 95 %"), rows, testid="deviation")
