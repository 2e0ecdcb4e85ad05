"""The plan that was sent to the robot and the drilled wire; both are restored from the journal after a restart."""

from dataclasses import dataclass
from datetime import datetime

import numpy as np

from sightline.app.plan.decisions import Decisions
from sightline.app.plan.marks import END, ENTRY
from sightline.app.plan.planner import Planned, planned
from sightline.app.texts import CHANGED_SINCE_SENT
from sightline.calibration import BeadView
from sightline.case.journal import Case, Kind
from sightline.case.views import ALL_NAMES
from sightline.errors import UnusableInputError
from sightline.planning import Plan
from sightline.planning.procedures import kind as kind_of
from sightline.robot.link.record import DrillingRecord
from sightline.robot.link.simulated import SimulatedWire

_SAME_MM = 1e-6  # tolerance for a plan that is computed again


@dataclass(frozen=True, eq=False)
class SentPlan:
    """A plan as sent to the robot, at the time `at`."""

    planned: Planned
    at: datetime

    @property
    def plan(self) -> Plan:
        """The plan."""
        assert self.planned.plan is not None  # noqa: S101 - nothing else is sent
        return self.planned.plan

    def holds_for(self, decisions: Decisions) -> bool:
        """Return True if decisions give the plan that was sent."""
        then = self.planned.decisions
        same = ("kind", "side", "serial")
        return (
            self.plan.kind.fingerprint == kind_of(decisions.kind).fingerprint  # its file may have changed since
            and all(getattr(then, name) == getattr(decisions, name) for name in same)
            and all(then.images.get(name) == decisions.images.get(name) for name in ALL_NAMES)
            and all(
                then.mirrored.get(at) == decisions.mirrored.get(at)
                for at in map(decisions.images.get, ALL_NAMES)
                if at is not None
            )
            and all(then.mark(name) == decisions.mark(name) for name in (ENTRY, END))
        )


@dataclass(frozen=True, eq=False)
class DrilledWire:
    """A wire drilled to its planned depth: its record, and the true pose from the simulator."""

    record: DrillingRecord
    wire: SimulatedWire


def restored(
    case: Case, decisions: Decisions, views: tuple[BeadView, ...]
) -> tuple[SentPlan, DrilledWire | None] | None:
    """Return what was sent and drilled before the program ended, from the journal; None if nothing was sent, or if
    images were replaced since. Raises UnusableInputError if the same decisions now give another plan."""
    sent = case.latest(Kind.SENT)
    if sent is None:
        return None
    then = Decisions.of(sent.content["decisions"])
    if any(then.images.get(name) != decisions.images.get(name) for name in ALL_NAMES):
        return None
    again = planned(then, views)
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
        raise UnusableInputError(CHANGED_SINCE_SENT)
    drilled = case.latest(Kind.DRILLED)
    if drilled is None or drilled.number < sent.number or "simulated_wire" not in drilled.content:
        return SentPlan(again, sent.at), None
    record, wire = drilled.content["record"], drilled.content["simulated_wire"]
    return SentPlan(again, sent.at), DrilledWire(DrillingRecord.of(record), SimulatedWire.of(wire))
