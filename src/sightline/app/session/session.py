"""A session: one procedure from the first image to the check shot, assembled from its parts; its report, and the cases
beside it."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING
from zipfile import ZIP_DEFLATED, ZipFile

from sightline.app.plan.decisions import Decisions
from sightline.app.session.bone import BoneStep
from sightline.app.session.drilling_workflow import DrillingWorkflow
from sightline.app.session.jobs import Jobs, WorkerProcess
from sightline.app.session.planning import PICKS, Planning
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

if TYPE_CHECKING:
    from sightline.case.deidentify import Deidentified


class Session:
    """One procedure on one case. Pages are listeners of `jobs`."""

    def __init__(self, case: Case, frame_ref: str, worker: WorkerProcess) -> None:
        self.jobs = Jobs()
        self.planning = Planning(case, frame_ref, worker, self.jobs)
        self.age = PlanAge(self.planning)
        self.bone = BoneStep(self.planning)
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


def export_files(folder: Path, confirmed: Sequence[Check]) -> tuple[dict[str, bytes], tuple[str, ...]]:
    """Write what is handed on of a case's last plan, as a zip, into the case's folder `export`, and return it by file
    name, with the views in whose images writing was found.

    It names no patient and holds no original: report, plan of each wire with the undistorted images, picks, frame file,
    and the plan's images de-identified. Runs in the worker. Raises what `report_files` raises, and ImageError.
    """
    from sightline.calibration.exchange.reading import json_bytes
    from sightline.case.interop.plan_file import bundle
    from sightline.case.report.content import report_of
    from sightline.case.report.document import report_document
    from sightline.case.report.page import render
    from sightline.case.saved import document

    with Case.open(folder, read_only=True) as case:
        made, images, number = report_of(case, confirmed), _without_identity(case), case.number
    plans = {"plan": made.plan} if made.wires is None else {f"plan-{k}": plan for k, plan in made.wires.plans.items()}
    bundled = {name: bundle(plan, made.images, made.frame) for name, plan in plans.items()}
    files = {
        "report.html": render(made).encode(),
        "report.json": report_document(made, number).model_dump_json(indent=1).encode(),
        "frame.json": made.frame.to_json(),
        **{f"{name}.json": json_bytes(document(plan, **bundled[name][0])) for name, plan in plans.items()},
        **{file: data for _, undistorted in bundled.values() for file, data in undistorted.items()},
        **{f"{view}.dcm": image.data for view, image in images.items()},
    }
    if (picks := folder / PICKS).is_file():
        files[PICKS] = picks.read_bytes()
    whole, name = io.BytesIO(), f"export-{number}"
    with ZipFile(whole, "w", ZIP_DEFLATED) as packed:
        for file, data in files.items():
            packed.writestr(f"{name}/{file}", data)
    write_folder(folder / "export", {f"{name}.zip": whole.getvalue()})
    written_in = (view for view, image in images.items() if image.burnt_in_stated or image.burnt_in_found)
    return {f"{name}.zip": whole.getvalue()}, tuple(written_in)


def _without_identity(case: Case) -> "dict[str, Deidentified]":
    """Return the images of the last plan without the patient's identity, by view; a table of beads has none."""
    from sightline.case.deidentify import Deidentifier

    planned, cleaner = case.latest(Kind.PLANNED), Deidentifier()
    views = [] if planned is None else [case.entry(number) for number in planned.rests_on]
    taken = {view.content["view"]: stages.acquired_of(case, view) for view in views}
    return {
        view: cleaner.clean(case.original(entry.content["original"]), entry.settings["frame_index"])
        for view, entry in taken.items()
        if not entry.content["original"].endswith(stages.TABLE)
    }


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
