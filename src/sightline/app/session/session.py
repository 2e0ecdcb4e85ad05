"""A session: one procedure from the first image to the check shot, assembled from its parts; its report, and the cases
beside it."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from sightline.app.plan.decisions import Decisions
from sightline.app.session.drilling_workflow import DrillingWorkflow
from sightline.app.session.jobs import Jobs, WorkerProcess
from sightline.app.session.planning import Planning
from sightline.app.session.readiness import PlanAge, Readiness
from sightline.app.session.rehearsing import Patient
from sightline.app.session.shots import Live, Shots
from sightline.app.session.verifying import Verifying
from sightline.case import stages
from sightline.case.journal import Actor, Case, Kind
from sightline.case.journal.case import JOURNAL
from sightline.common.atomic import write_folder
from sightline.common.checks import Check
from sightline.errors import SightlineError, UnusableInputError
from sightline.frame import Frame
from sightline.planning.procedures.procedure import document_of, each_wire


class Session:
    """One procedure on one case. Pages are listeners of `jobs`."""

    def __init__(self, case: Case, frame_ref: str, worker: WorkerProcess) -> None:
        self.jobs = Jobs()
        self.planning = Planning(case, frame_ref, worker, self.jobs)
        self.age = PlanAge(self.planning)
        self.readiness = Readiness(self.planning, self.age)
        self.drilling = DrillingWorkflow(self.planning, self.age, self.readiness)
        self.live = Live(self.planning)
        self.verifying = Verifying(self.planning)
        self.shots = Shots(self.planning, self.drilling)
        self.drilling.objection = lambda: self.shots.objection
        self.jobs.listeners += [self.verifying.update, self.shots.update]

    @staticmethod
    def open(folder: Path, frame_name: str | None, patient: Patient | None, worker: WorkerProcess) -> "Session":
        """Open the case in a folder, or create it with a frame and, if given, a patient to rehearse on.

        Raises CaseError, FrameError, UnusableInputError if the case has another frame than the one named."""
        # An invalid frame is refused before the case is created.
        frame = Frame.load(frame_name or ("gamma" if patient is None else patient.frame))
        case = Case.create(folder, exist_ok=True)
        if patient is not None and case.last == 0:
            stages.record_changed(case, "rehearsal", vars(patient), by=Actor.APP)
            first = each_wire(document_of(patient.procedure))[0].key
            if first != Decisions.kind:
                stages.record_changed(case, "edit", Decisions(kind=first).document(), by=Actor.APP)
        # The frame is recorded last: a case without one was interrupted during creation, or has only acquired images.
        kept = stages.frame_in_use(case)
        if kept is None:
            kept = stages.keep_frame(case, frame)
            stages.record_changed(case, "frame", kept, by=Actor.APP)
        if frame_name is not None and stages.keep_frame(case, frame) != kept:
            raise UnusableInputError(
                "open this case without --frame, or begin a new case for this frame: it was begun with another one"
            )
        return Session(case, kept, worker)

    def succeeded_by(self, folder: Path) -> "Session":
        """Return a session on another case, which exists. Nothing of this one is lost: a journal holds it.

        Raises CaseError, FrameError, and UnusableInputError while work on this case is in progress or the robot moves.
        """
        seen = (self.planning.seen(name) for name in self.planning.decisions.images)
        doing = self.jobs.working or next((image.doing for image in seen if image is not None and image.doing), "")
        now = self.drilling.now
        if doing:
            raise UnusableInputError(f"open the other case when this is done: {doing}")
        if now is not None and not now.lost and now.activity:
            raise UnusableInputError("stop the robot, or wait until its motion has ended, then open the other case")
        Case.open(folder, read_only=True).close()  # a folder without a case is refused, and not made one
        return Session.open(folder, None, None, self.planning.worker)

    async def close(self) -> None:
        """End the link to the robot first, then the live image, then close the case. No page is notified."""
        self.jobs.listeners.clear()
        await self.drilling.close()
        await self.live.close()
        self.planning.case.close()


MAX_LISTED = 50  # [ours] cases, the newest ones: nobody reads a longer list


@dataclass(frozen=True)
class CaseInFolder:
    """A case: its folder, number, time of the newest entry, and whether a wire is planned, drilled and verified."""

    folder: Path
    number: str
    at: datetime
    reached: Kind


def report_files(folder: Path, confirmed: Sequence[Check]) -> dict[str, bytes]:
    """Write the report of a case's last plan, as a page, into the case's folder `report`, and return it by file name.

    `confirmed`: as of `Report`. Runs in the worker. Raises CaseError if the case holds no plan; also raises the errors
    of the recomputed stages.
    """
    from sightline.case.report.content import report_of
    from sightline.case.report.page import render

    with Case.open(folder, read_only=True) as case:
        made, name = report_of(case, confirmed), f"report-{case.number}"
    files = {f"{name}.html": render(made).encode()}
    write_folder(folder / "report", files)
    return files


def cases_beside(folder: Path) -> list[CaseInFolder]:
    """Return the cases in the folder around a case's own, the newest first; those that cannot be read are left out."""
    cases = []
    for journal in folder.resolve().parent.glob(f"*/{JOURNAL}"):
        try:
            with Case.open(journal.parent, read_only=True) as case:
                last = case.entries()[-1:]
                reached = [kind for kind in (Kind.VERIFIED, Kind.DRILLED, Kind.PLANNED) if case.latest(kind)]
                if last:
                    here = reached[0] if reached else Kind.ACQUIRED
                    cases.append(CaseInFolder(journal.parent, case.number, last[0].at, here))
        except SightlineError:
            continue
    return sorted(cases, key=lambda listed: listed.at, reverse=True)[:MAX_LISTED]
