"""A procedure from its first image to its check shot, put together from its parts."""

from pathlib import Path

from sightline.app.session.age import PlanAge
from sightline.app.session.drilling import Drilling
from sightline.app.session.jobs import Jobs
from sightline.app.session.live import Live
from sightline.app.session.planning import Planning
from sightline.app.session.readiness import Readiness
from sightline.app.session.rehearsing import Patient
from sightline.app.session.verifying import Verifying
from sightline.app.session.workshop import Workshop
from sightline.case import stages
from sightline.case.journal import Actor, Case, Kind
from sightline.errors import UnusableInputError
from sightline.frame import Frame


class Procedure:
    """One procedure on one case. Pages are listeners of `jobs`."""

    def __init__(self, case: Case, frame_ref: str, workshop: Workshop) -> None:
        self.jobs = Jobs()
        self.planning = Planning(case, frame_ref, workshop, self.jobs)
        self.age = PlanAge(self.planning)
        self.readiness = Readiness(self.planning, self.age)
        self.drilling = Drilling(self.planning, self.age, self.readiness)
        self.live = Live(self.planning)
        self.verifying = Verifying(self.planning)
        self.jobs.listeners.append(self.verifying.update)

    @staticmethod
    def open(folder: Path, frame_name: str | None, patient: Patient | None, workshop: Workshop) -> "Procedure":
        """The case in a folder, made there where there is none: with a frame, and a patient to rehearse on if given.

        Raises CaseError, FrameError, UnusableInputError where the case has another frame than the one named."""
        frame = Frame.load(frame_name or "gamma")  # refused before a case is made for it
        case = Case.create(folder, exist_ok=True)
        if patient is not None and case.last == 0:
            stages.record_changed(case, "rehearsal", vars(patient), by=Actor.APP)
        # The frame comes last: a case without one was cut off while it was begun, or holds acquired images alone.
        if case.latest(Kind.CHANGED, where={"what": "frame"}) is None:
            stages.record_changed(case, "frame", stages.keep_frame(case, frame), by=Actor.APP)
        entry = case.latest(Kind.CHANGED, where={"what": "frame"})
        kept = "gamma" if entry is None else str(entry.content["to"])
        if frame_name is not None and stages.keep_frame(case, frame) != kept:
            raise UnusableInputError(
                "this case was begun with another frame; open it without --frame, or begin a new case for this frame"
            )
        return Procedure(case, kept, workshop)

    async def close(self) -> None:
        """End the link to the robot first, then the live image. No page is told, since its event loop has ended."""
        self.jobs.listeners.clear()
        await self.drilling.close()
        await self.live.close()
