"""The five steps of a procedure, and how far each is: done, to do, to be seen to, or blocked, with the reason."""

from dataclasses import dataclass
from enum import StrEnum

from sightline.app.marks import asked_of
from sightline.app.procedure import Procedure
from sightline.app.seen import SeenImage
from sightline.app.texts import IMAGE_LABELS, STEPS
from sightline.case.views import NAMES
from sightline.checks import failed
from sightline.robot.states import State


class Standing(StrEnum):
    """How far a step is."""

    DONE = "done"
    OPEN = "open"
    ATTENTION = "attention"
    BLOCKED = "blocked"


@dataclass(frozen=True)
class Step:
    """One step: its name, how far it is, and why, in a sentence."""

    name: str
    standing: Standing
    reason: str


def steps(procedure: Procedure) -> tuple[Step, ...]:
    """All five, in their order."""
    found = (_images(procedure), _calibrate(procedure), _plan(procedure), _drill(procedure), _verify(procedure))
    return tuple(Step(name, *one) for name, one in zip(STEPS, found, strict=True))


_Found = tuple[Standing, str]


def _both(procedure: Procedure) -> list[SeenImage]:
    return [seen for seen in map(procedure.seen, NAMES) if seen is not None]


def _images(procedure: Procedure) -> _Found:
    decisions, missing = procedure.decisions, [name for name in NAMES if name not in procedure.decisions.images]
    if procedure.working and missing:
        return Standing.OPEN, f"{procedure.working.capitalize()}."
    if missing:
        return Standing.OPEN, f"Drop the {' and the '.join(IMAGE_LABELS[name] for name in missing)} onto the page."
    if decisions.side is None or decisions.serial is None:
        return Standing.ATTENTION, "Confirm the patient's side and the frame's serial."
    return Standing.DONE, "Both images are here; side and frame are confirmed."


def _calibrate(procedure: Procedure) -> _Found:
    seen = _both(procedure)
    if len(seen) < len(NAMES):
        return Standing.BLOCKED, "Both images are needed first."
    if busy := next((one.doing for one in seen if one.doing), ""):
        return Standing.OPEN, f"{busy.capitalize()}."
    if refused := next((one.refused for one in seen if one.refused), ""):
        return Standing.ATTENTION, refused
    views = procedure.views()
    if views is None:
        return Standing.ATTENTION, "The two images show the same view; a PA and a lateral image are needed."
    wrong = failed(check for view in views for check in view.checks)
    if wrong:
        return Standing.ATTENTION, wrong[0].sentence
    return Standing.DONE, "Both views are calibrated from their own beads, and every check passed."


def _plan(procedure: Procedure) -> _Found:
    known = procedure.planned
    if known is None:
        return Standing.BLOCKED, "Both views must be calibrated first."
    if known.plan is None:
        refused = next(iter(known.refused.values()), None)
        if refused is not None:
            return Standing.ATTENTION, refused
        wire = [asked for asked in asked_of(procedure.decisions.kind) if asked.group == "wire"]
        left = [asked.label for asked in wire if not procedure.decisions.complete([asked.name])]
        return Standing.OPEN, f"Place in both images: {', '.join(left)}."
    wrong = failed(procedure.checks)
    return (Standing.ATTENTION, wrong[0].sentence) if wrong else (Standing.DONE, "GO: every check passed.")


def _drill(procedure: Procedure) -> _Found:
    drilling = procedure.drilling
    if drilling.record is not None:
        return Standing.DONE, "The wire is drilled to the planned depth."
    now = drilling.now
    if now is not None and (now.lost or now.fault or now.said):
        return Standing.ATTENTION, now.said or now.text or "The link to the robot is lost."
    if now is not None and drilling.sent is not None and now.state != State.UNDEFINED.value:
        return Standing.OPEN, f"The robot is in {now.state}."
    if not procedure.go:
        return Standing.BLOCKED, "Only a plan that is GO can be sent."
    return Standing.OPEN, "The plan can be sent to the robot."


def _verify(procedure: Procedure) -> _Found:
    verifying = procedure.verifying
    if verifying.refused:
        return Standing.ATTENTION, verifying.refused
    if verifying.shot is not None:
        wrong = failed(verifying.shot.checks)
        if wrong:
            return Standing.ATTENTION, wrong[0].sentence
        return Standing.DONE, "The wire in the bone was measured in two more images, and lies where it was planned."
    if procedure.drilling.sent is None:
        return Standing.BLOCKED, "Nothing was drilled yet."
    return Standing.OPEN, "Take two more images, with the wire in the bone."
