"""The five steps of a procedure with their status, done, open, attention or blocked, and the reason for it."""

from dataclasses import dataclass
from enum import StrEnum

from sightline.app import texts
from sightline.app.panels.needed import aid_labels, needed_aids
from sightline.app.plan.marks import CHECK_NAMES
from sightline.app.plan.planner import Planned
from sightline.app.session.planning import Planning
from sightline.app.session.seen import SeenImage
from sightline.app.session.session import Session
from sightline.app.tab.step import ProcedureStep
from sightline.app.tab.view_names import image_name
from sightline.case.views import NAMES
from sightline.checks import failed
from sightline.planning.results import Verdict
from sightline.robot.control.states import State


class StepStatus(StrEnum):
    """Status of a step."""

    DONE = "done"
    OPEN = "open"
    ATTENTION = "attention"
    BLOCKED = "blocked"


@dataclass(frozen=True)
class WorkflowStep:
    """One step, its status, and the reason for it as a sentence."""

    step: ProcedureStep
    status: StepStatus
    reason: str


def steps(session: Session) -> tuple[WorkflowStep, ...]:
    """Return all five steps in order."""
    found = (
        _images(session),
        _calibrate(session.planning),
        _plan(session),
        _drill(session),
        _verify(session),
    )
    return tuple(WorkflowStep(step, *one) for step, one in zip(ProcedureStep, found, strict=True))


def waits_for(session: Session, step: ProcedureStep) -> ProcedureStep | None:
    """Return the first step that a blocked one waits for; None for another one."""
    listed = steps(session)
    here = next(one for one in listed if one.step is step)
    earlier = (one.step for one in listed if one.step.number < step.number and one.status != StepStatus.DONE)
    return next(earlier, None) if here.status is StepStatus.BLOCKED else None


_Found = tuple[StepStatus, str]


def _present(planning: Planning) -> list[SeenImage]:
    return [seen for seen in map(planning.seen, planning.slots) if seen is not None]


def _is_refused(planning: Planning, image: str) -> bool:
    seen = planning.seen(image)
    return seen is not None and bool(seen.refused)


def _images(session: Session) -> _Found:
    planning, working = session.planning, session.jobs.working
    decisions = planning.decisions
    missing = [name for name in NAMES if name not in decisions.images]
    if working and missing:
        return StepStatus.OPEN, texts.DOING.format(doing=texts.titled(texts.word(working)))
    if missing:
        return StepStatus.OPEN, texts.DROP_MISSING.format(
            images=texts.DROP_AND.join(image_name(name, decisions.kind) for name in missing)
        )
    left = _left_of_images(session)
    return (StepStatus.ATTENTION, left) if left else (StepStatus.DONE, texts.IMAGES_DONE)


def _left_of_images(session: Session) -> str:
    """Return what is left to do with loaded images; empty if nothing."""
    planning = session.planning
    decisions, asked = planning.decisions, planning.asks_mirrored
    if refused := [image_name(name, decisions.kind) for name in NAMES if _is_refused(planning, name)]:
        return texts.LOAD_ANOTHER.format(image=refused[0])
    if decisions.side is None or decisions.serial is None:
        return texts.CONFIRM_BOTH
    if any(session.age.taken_at(seen) is None for seen in _present(planning)):
        return texts.STATE_WHEN_TAKEN
    if asked and not any(decisions.images[name] in decisions.mirrored for name in asked):
        return texts.STATE_WHETHER_MIRRORED
    return ""


def _calibrate(planning: Planning) -> _Found:
    seen = _present(planning)
    if any(planning.seen(name) is None for name in NAMES):
        return StepStatus.BLOCKED, texts.IMAGES_FIRST
    if busy := next((one.doing for one in seen if one.doing), ""):
        return StepStatus.OPEN, texts.DOING.format(doing=texts.titled(texts.word(busy)))
    if refused := next((one.refused for one in seen if one.refused), ""):
        return StepStatus.ATTENTION, refused
    views = planning.views()
    if views is None:
        return StepStatus.ATTENTION, texts.SAME_VIEW
    wrong = failed(check for view in views for check in view.checks)
    if wrong:
        return StepStatus.ATTENTION, texts.said(wrong[0])
    return StepStatus.DONE, texts.CALIBRATED


def _plan(session: Session) -> _Found:
    known, decisions = session.planning.planned, session.planning.decisions
    if session.planning.lacking:
        return StepStatus.ATTENTION, " ".join(texts.LACKS[session.planning.lacking])
    if known is None:
        return StepStatus.BLOCKED, texts.CALIBRATE_FIRST
    if known.plan is None:
        if refused := refusals(known):
            return StepStatus.ATTENTION, refused[0]
        if decisions.of_nail and session.planning.nail.searching:
            return StepStatus.OPEN, texts.SEARCHING_NAIL
        wire = [spec for spec in decisions.specs if spec.group in ("wire", "nail")]
        left = [texts.word(spec.label) for spec in wire if not decisions.complete([spec.name])]
        return StepStatus.OPEN, texts.PLACE_WIRE.format(points=", ".join(left))
    return _judged(known, session.readiness.verdict)


def _judged(known: Planned, verdict: Verdict | None) -> _Found:
    """Return `judged`, and of a plan that only lacks aids which ones to draw."""
    status, reason = judged(verdict)
    aids = () if verdict is None or status is not StepStatus.OPEN else needed_aids(known, verdict)
    return status, texts.LEFT.format(what=", ".join(aid_labels(known.kind, aids))) if aids else reason


def judged(verdict: Verdict | None) -> _Found:
    """Return the status by the checks: what is not placed is left to do, only a check that failed needs attention."""
    wrong = [] if verdict is None else sorted(failed(verdict.checks), key=lambda one: one in verdict.unmade)
    if verdict is None or not wrong:
        return StepStatus.DONE, texts.PLAN_DONE
    return StepStatus.OPEN if wrong[0] in verdict.unmade else StepStatus.ATTENTION, texts.said(wrong[0])


def refusals(known: Planned) -> tuple[str, ...]:
    """Return why results are missing, each reason once; that of one of a nail's holes names it."""
    holes = {spec.name: texts.word(spec.label) for spec in known.decisions.specs if spec.group == "nail"}
    named = (f"{holes[name]}: {why}" if name in holes else why for name, why in known.refused.items())
    return tuple(dict.fromkeys(named))


def _drill(session: Session) -> _Found:
    planning, now = session.planning, session.drilling.now
    if set(planning.kinds) <= set(planning.all_drilled):
        return StepStatus.DONE, texts.DRILL_DONE
    if now is not None and now.lost:
        return StepStatus.ATTENTION, texts.LINK_LOST
    if now is not None and (now.fault or now.last_error):
        return StepStatus.ATTENTION, now.last_error or now.text
    if session.drilling.changed == texts.CHANGED_AFTER_SENDING:
        return StepStatus.ATTENTION, texts.CHANGED_AFTER_SENDING
    if now is not None and planning.sent is not None and now.state != State.UNDEFINED.value:
        state = texts.ROBOT_IN.format(state=texts.STATES.get(now.phase, texts.STATE_UNKNOWN))
        return StepStatus.OPEN, texts.ROBOT_NEXT.get(now.phase, state)
    return _send(session, linked=now is not None and not now.lost)


def _send(session: Session, *, linked: bool) -> _Found:
    if not session.readiness.can_send:
        return StepStatus.BLOCKED, texts.ONLY_GO
    if session.planning.patient is None:
        return StepStatus.BLOCKED, texts.NO_ROBOT_IN_IMAGES
    return StepStatus.OPEN, texts.CAN_SEND if linked else texts.CAN_START


def missing_again(planning: Planning) -> list[str]:
    """Return the labels of the plan's landmarks that are not found again in both check images."""
    mark = planning.decisions.mark
    return [texts.word(one.label) for one in planning.landmarks if not mark(one.name).complete(CHECK_NAMES)]


def _verify(session: Session) -> _Found:
    planning, verifying, kinds = session.planning, session.verifying, session.planning.kinds
    refused = [verifying.refusals[kind] for kind in kinds if kind in verifying.refusals]
    if refused:
        return StepStatus.ATTENTION, refused[0]
    shots = [verifying.shots[kind] for kind in kinds if kind in verifying.shots]
    if shots:
        wrong = failed((*(check for one in shots for check in one.checks), *verifying.relations()))
        if wrong:
            return StepStatus.OPEN if missing_again(planning) else StepStatus.ATTENTION, texts.said(wrong[0])
        if len(shots) == len(kinds):
            return StepStatus.DONE, texts.VERIFIED
        if verifying.shot is not None:
            return StepStatus.OPEN, texts.GO_ON_VERIFYING
    if not planning.all_sent:
        return StepStatus.BLOCKED, texts.NOT_DRILLED
    return StepStatus.OPEN, texts.SHOT_MEASURING if verifying.measuring else texts.TAKE_TWO_MORE
