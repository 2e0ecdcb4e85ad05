"""Make the report of a case's last plan."""

from sightline.case.journal import Case, Entry, Kind
from sightline.case.replay import Recomputed
from sightline.case.report import exposures
from sightline.case.report.content import Report
from sightline.case.report.drilled import Drilled
from sightline.case.stages import frame_of
from sightline.errors import CaseError
from sightline.planning.check.shot import ALIGNED, PAUSED
from sightline.robot.link.record import DrillingRecord


def report_of(case: Case) -> Report:
    """Return the report of the last plan and its drilling, recomputed from the originals, which name the images.

    Raises CaseError if the case holds no plan; also raises the errors of the recomputed stages.
    """
    entry = case.latest(Kind.PLANNED)
    if entry is None:
        raise CaseError("the case holds no plan yet; plan first, then report")
    again = Recomputed(case)
    made = again.plan(entry)
    return Report(
        title=f"Case {case.number}",
        frame=frame_of(case, case.entry(entry.rests_on[0]).settings["frame"]),
        images=again.images(entry),
        plan=made,
        wires=again.wires(entry),
        measured=again.measured(entry),
        exposures=exposures.of_case(case, entry, made.kind),
        drilled=_drilled(case, entry, again),
        provenance={
            "case": f"{case.number}, entry {entry.number} of {case.last}",
            "planned": f"{entry.at:%Y-%m-%d %H:%M} UTC, by {entry.by}",
            "journal": f"the hash chain is {entry.chain[:16]} at entry {entry.number}",
        },
    )


def _drilled(case: Case, plan: Entry, again: Recomputed) -> Drilled | None:
    """Return the last drilling record and the last check shot since the plan; None if there is neither."""
    drilled = case.entries(Kind.DRILLED, plan.number)
    own = [one for one in drilled if not one.rests_on or plan.number in one.rests_on]  # not of another wire
    records = [one.content["record"] for one in own if "record" in one.content]
    shots = [one for one in case.entries(Kind.VERIFIED, plan.number) if _is_measured(one, plan)]
    drilling = {one.content["asked"]["straight"]: one for one in case.entries(Kind.SHOT, plan.number)}
    if not records and not shots and not drilling:
        return None
    return Drilled(
        target=None,
        record=DrillingRecord.of(records[-1]) if records else None,
        check=again.shot(shots[-1]) if shots else None,
        shots={ALIGNED if straight else PAUSED: again.drill_shot(one) for straight, one in drilling.items()},
    )


def _is_measured(verified: Entry, plan: Entry) -> bool:
    """Whether a check shot is of this plan, and its entry holds the request, which earlier versions did not record."""
    return plan.number in verified.rests_on and "asked" in verified.content
