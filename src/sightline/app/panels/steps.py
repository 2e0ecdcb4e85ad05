"""The five steps of a procedure with their status and its reason, and the chooser of the current wire with the state of
each."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain

from nicegui import ui

from sightline.app import texts
from sightline.app.panels.section import PersistentSection, Section, action, note
from sightline.app.plan.planner import Planned, lowest_wire
from sightline.app.session.planning import Planning
from sightline.app.session.seen import SeenImage
from sightline.app.session.session import Session
from sightline.app.tab.placing import ProcedureStep
from sightline.app.tab.tab import Tab
from sightline.app.texts import image_name
from sightline.case.views import CHECK_NAMES, NAMES
from sightline.common.checks import CheckCode, advised, failed
from sightline.planning.points.results import Verdict
from sightline.planning.procedures import Procedure
from sightline.planning.procedures import kind as kind_of
from sightline.planning.procedures.document import CHECKS
from sightline.robot.control.states import State

# Directions of the bone that a check takes from the procedure.
_OF_BONE = {CheckCode.VIEW_DIRECTIONS: 2, CheckCode.SIDE: 3}


def needed_aids(known: Planned, verdict: Verdict) -> tuple[str, ...]:
    """Return the keys of the aids that are not drawn and without which checks of a verdict cannot be made, in the order
    of the procedure."""
    kind, unmade = known.kind, {check.code for check in verdict.unmade}
    needs = {"head"} if CheckCode.HEAD in unmade else set[str]()
    for rule in kind.checks:
        if rule.code in unmade:
            needs.update(*CHECKS[rule.check].needs[:1])
    if known.decisions.side is not None:  # else that is what these two wait for
        needs.update(*(_of_bone(kind, count) for code, count in _OF_BONE.items() if code in unmade))
    return tuple(aid.key for aid in kind.aids if aid.key in needs and known.anatomy.undrawn(aid.key))


def _of_bone(kind: Procedure, count: int) -> set[str]:
    """Return the keys that the first directions of the bone are made of; none where the procedure has fewer."""
    directions = kind.document.directions
    if len(directions) < count:
        return set()
    return set(
        chain.from_iterable(
            (*direction.from_, *direction.to, direction.along or "") for direction in directions[:count]
        )
    )


def aid_labels(kind: Procedure, keys: Sequence[str]) -> tuple[str, ...]:
    """Return the names of aids, by their keys."""
    names = {aid.key: texts.titled(aid.name) for aid in kind.aids}
    return tuple(names[key] for key in keys)


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
    judgements = (
        _images(session),
        _calibrate(session.planning),
        _plan(session),
        _drill(session),
        _verify(session),
    )
    return tuple(WorkflowStep(step, *judgement) for step, judgement in zip(ProcedureStep, judgements, strict=True))


def waits_for(session: Session, step: ProcedureStep) -> ProcedureStep | None:
    """Return the first step that a blocked one waits for; None for another one."""
    listed = steps(session)
    here = next(each for each in listed if each.step is step)
    earlier = (each.step for each in listed if each.step.number < step.number and each.status != StepStatus.DONE)
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
        return StepStatus.OPEN, f"{texts.titled(working)}."
    if missing:
        names = " and the ".join(image_name(name, decisions.kind) for name in missing)
        return StepStatus.OPEN, f"Drop the {names} onto the page."
    left = _left_of_images(session)
    return (
        (StepStatus.ATTENTION, left)
        if left
        else (StepStatus.DONE, "Both images are loaded; side and frame are confirmed.")
    )


def _left_of_images(session: Session) -> str:
    """Return what is left to do with loaded images; empty if nothing."""
    planning = session.planning
    decisions, asked = planning.decisions, planning.asks_mirrored
    if refused := [image_name(name, decisions.kind) for name in NAMES if _is_refused(planning, name)]:
        return f"Load another {refused[0]}: this one cannot be used."
    if decisions.side is None or decisions.serial is None:
        return "Confirm the patient's side and the frame's serial."
    if any(session.age.taken_at(seen) is None for seen in _present(planning)):
        return "State when the images without a recorded time were taken."
    if asked and not any(decisions.images[name] in decisions.mirrored for name in asked):
        return "State whether writing in the images reads backwards."
    return ""


def _calibrate(planning: Planning) -> _Found:
    seen = _present(planning)
    if any(planning.seen(name) is None for name in NAMES):
        return StepStatus.BLOCKED, "Load both images first."
    if busy := next((image.doing for image in seen if image.doing), ""):
        return StepStatus.OPEN, f"{texts.titled(busy)}."
    if refused := next((image.refused for image in seen if image.refused), ""):
        return StepStatus.ATTENTION, refused
    views = planning.views()
    if views is None:
        return StepStatus.ATTENTION, "Load another image: both show the same view."
    wrong = failed(check for view in views for check in view.checks)
    if wrong:
        return StepStatus.ATTENTION, texts.sentence(wrong[0])
    return StepStatus.DONE, "Both views are calibrated, and every check passed."


def _plan(session: Session) -> _Found:
    known, decisions = session.planning.planned, session.planning.decisions
    if session.planning.lacking:
        return StepStatus.ATTENTION, " ".join(texts.LACKS[session.planning.lacking])
    if known is None:
        return StepStatus.BLOCKED, "Calibrate both views first."
    if known.plan is None:
        if refused := refusals(known):
            return StepStatus.ATTENTION, refused[0]
        if decisions.of_nail and session.planning.nail.searching:
            return StepStatus.OPEN, texts.SEARCHING_NAIL
        wire = [spec for spec in decisions.specs if spec.group in ("wire", "nail")]
        left = [spec.label for spec in wire if not decisions.complete([spec.name])]
        return StepStatus.OPEN, "Place in both images: " + ", ".join(left) + "."
    return _judged(session.planning, known, session.readiness.verdict)


def _judged(planning: Planning, known: Planned, verdict: Verdict | None) -> _Found:
    """Return `judged`, and of a plan that only lacks wires and aids which ones to place."""
    status, reason = judged(verdict)
    if verdict is None or status is not StepStatus.OPEN:
        return status, reason
    left = (*missing_labels(planning), *aid_labels(known.kind, needed_aids(known, verdict)))
    return status, texts.LEFT.format(what=", ".join(left)) if left else reason


def judged(verdict: Verdict | None) -> _Found:
    """Return the status by the checks: what is not placed is left to do, only a check that failed needs attention."""
    wrong = () if verdict is None else advised(verdict.checks)
    if verdict is None or not wrong:
        return StepStatus.DONE, "GO: every check passed."
    return StepStatus.OPEN if wrong[0].missing else StepStatus.ATTENTION, texts.sentence(wrong[0])


def refusals(known: Planned) -> tuple[str, ...]:
    """Return why results are missing, each reason once; that of one of a nail's holes names it."""
    holes = {spec.name: spec.label for spec in known.decisions.specs if spec.group == "nail"}
    named = (f"{holes[name]}: {why}" if name in holes else why for name, why in known.refused.items())
    return tuple(dict.fromkeys(named))


def _drill(session: Session) -> _Found:
    planning, now = session.planning, session.drilling.now
    if set(planning.kinds) <= set(planning.all_drilled):
        return StepStatus.DONE, "Drilling is done."
    if now is not None and now.lost:
        return StepStatus.ATTENTION, texts.LINK_LOST
    if now is not None and (now.fault or now.last_error):
        return StepStatus.ATTENTION, now.last_error or now.text
    if session.drilling.changed == texts.CHANGED_AFTER_SENDING:
        return StepStatus.ATTENTION, texts.CHANGED_AFTER_SENDING
    if now is not None and planning.sent is not None and now.state != State.UNDEFINED.value:
        state = f"{texts.STATES.get(now.phase, texts.STATE_UNKNOWN)}."
        return StepStatus.OPEN, texts.ROBOT_NEXT.get(now.phase, state)
    return _send(session, linked=now is not None and not now.lost)


def _send(session: Session, *, linked: bool) -> _Found:
    if not session.readiness.can_send:
        return StepStatus.BLOCKED, texts.ONLY_GO
    if session.planning.patient is None:
        return StepStatus.BLOCKED, (
            "These images carry no robot pose: the plan cannot be sent to a robot. Save its report."
        )
    return StepStatus.OPEN, "Send the plan to the robot." if linked else "Start the robot, then send the plan."


def missing_again(planning: Planning) -> list[str]:
    """Return the labels of the plan's landmarks that are not found again in both check images."""
    mark = planning.decisions.mark
    return [spec.label for spec in planning.landmarks if not mark(spec.name).complete(CHECK_NAMES)]


def _verify(session: Session) -> _Found:
    planning, verifying, kinds = session.planning, session.verifying, session.planning.kinds
    refused = [verifying.refusals[kind] for kind in kinds if kind in verifying.refusals]
    if refused:
        return StepStatus.ATTENTION, refused[0]
    shots = [verifying.shots[kind] for kind in kinds if kind in verifying.shots]
    if shots:
        wrong = failed((*(check for shot in shots for check in shot.checks), *verifying.relations()))
        if wrong:
            return StepStatus.OPEN if missing_again(planning) else StepStatus.ATTENTION, texts.sentence(wrong[0])
        if len(shots) == len(kinds):
            return StepStatus.DONE, "The wire was measured in two check images and lies as planned."
        if verifying.shot is not None:
            return StepStatus.OPEN, "This wire lies as planned: go on with the next one."
    if not planning.all_sent:
        return StepStatus.BLOCKED, "Nothing has been drilled yet."
    return (
        StepStatus.OPEN,
        texts.SHOT_MEASURING if verifying.measuring else "Take two check images with the wire in the bone.",
    )


_BEFORE = (ProcedureStep.IMAGES, ProcedureStep.CALIBRATE)  # steps before wires are planned


def build_wires(tab: Tab) -> None:
    """Build the chooser, whose buttons persist while states change, and the order of drilling below it."""
    Section(tab, _listed, _listed_wires)
    Section(tab, lambda t: (t.step, t.planning.kinds, t.planning.drilling_order), _order)


def _listed(tab: Tab) -> tuple[str, ...]:
    """Return the wires to choose from; none for a single wire, and before they are planned."""
    kinds = tab.planning.kinds
    return () if len(kinds) == 1 or tab.step in _BEFORE else kinds


def _listed_wires(tab: Tab) -> None:
    if _listed(tab):
        PersistentSection(tab, _states, _chooser)


def _states(tab: Tab) -> Hashable:
    return tab.planning.decisions.kind, tuple((kind, wire_state(tab, kind)) for kind in tab.planning.kinds)


def wire_state(tab: Tab, kind: str) -> str:
    """Return the state of a wire, as a key of `texts.WIRE_STATES`."""
    planning, shot = tab.planning, tab.session.verifying.shots.get(kind)
    if shot is not None:
        return "verified" if shot.passed else "refuted"
    if kind in tab.session.verifying.refusals:
        return "refuted"
    if kind in planning.all_drilled:
        return "drilled"
    plan = None if tab.known is None else tab.known.plans.get(kind)
    held = tab.session.drilling.held
    if plan is not None and held is not None and held is planning.all_sent.get(kind):
        return "sent"
    return "missing" if plan is None else plan.verdict.state


def _chooser(tab: Tab) -> Callable[[], None]:
    """Build a button for each wire of the procedure, and return what updates them."""
    made: dict[str, tuple[ui.button, ui.label]] = {}
    with ui.element("div").classes("wires").props('role=group aria-label="Wires of the procedure"'):
        for kind in tab.planning.kinds:
            wire = kind_of(kind).wire
            name = texts.titled(wire.name).removesuffix(" wire")
            with action(
                name,
                lambda kind=kind: tab.choose(tab.planning.decisions.with_kind(kind)),
                testid=f"wire-{wire.key}",
                kind="small",
            ) as button:
                made[kind] = button, ui.label().classes("wire-state unseen")

    states = " ".join(("here", *(f"wire-{key}" for key in texts.WIRE_STATES)))

    def update() -> None:
        for kind, (button, label) in made.items():
            here, now = kind == tab.planning.decisions.kind, wire_state(tab, kind)
            button.classes(f"wire-{now} {'here' if here else ''}", remove=states)
            button.props(f"aria-pressed={'true' if here else 'false'}")
            label.set_text(texts.WIRE_STATES[now])

    return update


def _order(tab: Tab) -> None:
    """Build the sentence on the order of drilling, on the step Drill; nothing where there is none."""
    order = tab.planning.drilling_order
    if tab.step is ProcedureStep.DRILL and order is not None and len(tab.planning.kinds) > 1:
        names = {kind_of(kind).wire.key: kind_of(kind).wire.name for kind in tab.planning.kinds}
        wires = ", then the ".join(names[key] for key in order.keys)
        note(
            f"Drill the {wires}: so the wires in the bone hide the fewest beads.", kind="quiet", testid="drilling-order"
        )


def next_wire(tab: Tab) -> str | None:
    """Return the wire to drill next, in the proposed order; None where all are drilled."""
    planning = tab.planning
    order = () if planning.drilling_order is None else planning.drilling_order.keys
    kinds = [kind for key in order for kind in planning.kinds if kind_of(kind).wire.key == key]
    return next((kind for kind in kinds if kind not in planning.all_drilled), None)


def missing_wires(planning: Planning) -> tuple[str, ...]:
    """Return the kinds of the other wires that are not placed; none before the current one is planned, and through
    the holes of a nail, which are all asked for together."""
    known = planning.planned
    if known is None or known.plan is None or planning.decisions.of_nail:
        return ()
    return tuple(kind for kind in planning.kinds if kind not in known.plans)


def missing_labels(planning: Planning) -> tuple[str, ...]:
    """Return the names of `missing_wires`."""
    return tuple(texts.titled(kind_of(kind).wire.name) for kind in missing_wires(planning))


def build_missing_wire(tab: Tab) -> None:
    """Build the button that places the other wires beside the lowest one, or leads to the next one to place."""
    planning = tab.planning
    lowest, missing = lowest_wire(kind_of(planning.decisions.kind).document), missing_wires(planning)
    known = planning.planned
    if known is not None and [kind_of(kind).wire.key for kind in known.plans] == [lowest]:
        action(texts.PROPOSE_OTHERS, tab.doing(planning.propose_others), testid="propose-next", kind="primary")
    else:
        _lead_to(tab, missing[0])


def _lead_to(tab: Tab, kind: str, step: ProcedureStep = ProcedureStep.PLAN) -> None:
    """Build the button that leads to another wire, on a step."""

    async def follow() -> None:
        await tab.choose(tab.planning.decisions.with_kind(kind))
        if tab.step is not step:
            tab.go_to(step)

    action(f"Next: {kind_of(kind).wire.name}", follow, testid="next-wire", kind="primary")


def build_next_wire(tab: Tab) -> None:
    """Build the button that leads to the wire to drill next."""
    after = next_wire(tab)
    assert after is not None  # noqa: S101 - it is asked before
    _lead_to(tab, after, ProcedureStep.DRILL)
