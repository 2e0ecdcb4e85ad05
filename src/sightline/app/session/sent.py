"""The plan that was sent to the robot and the drilled wire; both are restored from the journal after a restart."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

import numpy as np

from sightline.app.plan.decisions import Decisions
from sightline.app.plan.found_bone import BoneInViews
from sightline.app.plan.marks import MarkSpec, names_of
from sightline.app.plan.planner import (
    PICK_SD_PX,
    ROBOT_WIRE,
    HolesFound,
    Planned,
    has_borders,
    has_head,
    of_wire,
    planned,
)
from sightline.calibration import BeadView
from sightline.case.journal import Case, Entry, Kind
from sightline.case.views import ALL_NAMES, NAMES
from sightline.errors import UnusableInputError
from sightline.planning import Plan
from sightline.planning.check.wires import Landmarks
from sightline.planning.procedures import kind as kind_of
from sightline.robot.link.record import DrillingRecord, SimulatedWire


class ZeroSource(StrEnum):
    """A source of the zero of depth."""

    PLAN = "plan"
    CONTACT = "contact"
    SHOT = "shot"


_SAME_MM = 1e-6  # tolerance for a plan that is computed again


@dataclass(frozen=True, eq=False)
class SentPlan:
    """A plan as sent to the robot, at the time `at`, by the journal's entry of this `number`."""

    planned: Planned
    at: datetime
    number: int = 0

    @property
    def plan(self) -> Plan:
        """The plan."""
        assert self.planned.plan is not None  # noqa: S101 - nothing else is sent
        return self.planned.plan

    def holds_for(self, decisions: Decisions) -> bool:
        """Return True if decisions give the plan that was sent, with the verdict and the depth limit that it was sent
        with, whichever wire is the current one."""
        then = self.planned.decisions
        same = ("side", "serial", "bone")
        return (
            self.plan.kind.fingerprint == kind_of(decisions.kind).fingerprint  # its file may have changed since
            and all(getattr(then, name) == getattr(decisions, name) for name in same)
            and all(then.images.get(name) == decisions.images.get(name) for name in ALL_NAMES)
            and all(
                then.mirrored.get(at) == decisions.mirrored.get(at)
                for at in map(decisions.images.get, ALL_NAMES)
                if at is not None
            )
            and all(then.mark(spec.name) == decisions.mark(spec.name) for spec in ROBOT_WIRE)
            and of_wire(then, then.kind) == of_wire(decisions, then.kind)
            and _around(then, then.specs) == _around(decisions, then.specs)
        )


@dataclass(frozen=True, eq=False)
class DrilledWire:
    """A wire drilled to its planned depth: its record, and the true pose from the simulator."""

    record: DrillingRecord
    wire: SimulatedWire


def _around(decisions: Decisions, specs: Sequence[MarkSpec]) -> tuple[object, ...]:
    """Return what verdict and depth limit of a wire follow from beside itself: landmarks and aids in the images of the
    plan, how axes are drawn, and what was fitted to edges."""
    marks = [decisions.mark(spec.name) for spec in specs if spec.group in ("landmark", "aid")]
    head = decisions.fitted_head if has_head(decisions) else None
    axes = (decisions.borders, decisions.fitted_shaft, decisions.fitted_neck) if has_borders(decisions) else None
    return tuple(mark.at(image) for mark in marks for image in ALL_NAMES), head, axes


def found_again(then: Decisions, now: Decisions, images: tuple[str, ...]) -> Landmarks:
    """Return the landmarks that a plan was made with and that are placed in both of two later images."""
    names = [
        name
        for name in names_of(then.kind, "landmark")
        if then.mark(name).complete() and now.mark(name).complete(images)
    ]
    planned_px, found_px = (
        np.array([[decisions.mark(name).at(image) for name in names] for image in places]).reshape(2, -1, 2)
        for decisions, places in ((then, NAMES), (now, images))
    )
    return Landmarks(planned_px, found_px, PICK_SD_PX)


def restored(
    case: Case,
    decisions: Decisions,
    views: tuple[BeadView, ...],
    holes_of: Callable[[Decisions], HolesFound | None] = lambda then: None,
    bone_of: Callable[[Decisions], BoneInViews | None] = lambda then: None,
) -> dict[str, tuple[SentPlan, DrilledWire | None]]:
    """Return what was sent and drilled on these images before the program ended, the last of each wire, by kind, from
    the journal. `holes_of`: finds the holes of a nail; `bone_of`: the accepted bone. Raises UnusableInputError if the
    same decisions now give another plan."""
    sent: dict[str, Entry] = {}
    for entry in case.entries(Kind.SENT):
        then = Decisions.of(entry.content["decisions"])
        if all(then.images.get(name) == decisions.images.get(name) for name in ALL_NAMES):
            sent[then.kind] = entry
    made = {kind: Decisions.of(entry.content["decisions"]) for kind, entry in sent.items()}
    again = {kind: planned(then, views, holes_of(then), bone_of(then)) for kind, then in made.items()}
    return {kind: _restored(case, entry, again[kind]) for kind, entry in sent.items()}


def _restored(case: Case, sent: Entry, again: Planned) -> tuple[SentPlan, DrilledWire | None]:
    if (
        again.plan is None
        or sent.content.get("procedure", again.kind.fingerprint) != again.kind.fingerprint
        or not np.allclose(
            [again.plan.trajectory.entry_mm, again.plan.trajectory.end_mm],
            [sent.content["trajectory"][key] for key in ("entry_mm", "end_mm")],
            rtol=0.0,
            atol=_SAME_MM,
        )
    ):
        raise UnusableInputError(
            "Send the plan again: the plan that was sent is no longer reproduced exactly, "
            "perhaps by another version of the software, and is not restored."
        )
    made = SentPlan(again, sent.at, sent.number)
    later = [entry.number for entry in case.entries(Kind.SENT, sent.number)]
    drilled = next(iter(case.entries(Kind.DRILLED, sent.number)), None)
    if drilled is None or min(later, default=drilled.number) < drilled.number:
        return made, None
    if "simulated_wire" not in drilled.content:
        return made, None
    record, wire = drilled.content["record"], drilled.content["simulated_wire"]
    return made, DrilledWire(DrillingRecord.of(record), SimulatedWire.of(wire))
