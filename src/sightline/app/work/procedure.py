"""One case at work: its images, what people decided, what follows. The journal has it all before a page shows it."""

import asyncio
import traceback
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import cached_property
from math import isfinite
from pathlib import Path
from time import monotonic
from typing import Any, TypeVar

from sightline.app.texts import BUG, MIRRORED_REFUSED, TAKEN_REFUSED
from sightline.app.work import rehearsing
from sightline.app.work.decisions import Decisions, Display, History, Pixel, Side
from sightline.app.work.drilling import Drilling
from sightline.app.work.live import Live
from sightline.app.work.marks import CHECK_NAMES
from sightline.app.work.planner import Planned, moved, planned
from sightline.app.work.rehearsing import Patient
from sightline.app.work.seen import Lightbox, SeenImage
from sightline.app.work.verifying import Verifying
from sightline.app.work.workshop import Workshop, warm_up
from sightline.calibration import BeadView
from sightline.case import stages
from sightline.case.journal import Actor, Case, Kind
from sightline.case.views import NAMES
from sightline.checks import Check
from sightline.errors import SightlineError, UnusableInputError
from sightline.frame import Frame
from sightline.planning.results import Verdict
from sightline.robot.kinematics.target import LIFETIME_S

T = TypeVar("T")
_TAKEN_IN = 8  # images that are looked at when a case has none placed [ours]
_CLOCKS_APART = timedelta(seconds=5)  # of C-arm and this machine, both set by the same time server [ours]
_LONGEST_AGO_MIN = 1e6  # two years [ours]
_EDITS = ("edit", "undo", "redo")


class Procedure:
    """`changed` listeners are called, on the event loop, whenever something that a page shows is another."""

    def __init__(self, case: Case, frame_ref: str, workshop: Workshop) -> None:
        self.case, self.frame, self.workshop = case, stages.frame_of(case, frame_ref), workshop
        self.listeners: list[Callable[[], None]] = []
        self.working = ""  # what is being done that is no single image's
        self.trouble = ""  # why the last of it failed
        self.lightbox = Lightbox(case, frame_ref, workshop, self.notify)
        changes = [entry.content for entry in case.entries(Kind.CHANGED) if entry.content["what"] in _EDITS]
        self.history = History((one["what"], None if one["to"] is None else Decisions.of(one["to"])) for one in changes)
        self._planned: Planned | None = None
        self._aged: dict[datetime, tuple[float, float]] = {}  # by a plan's time: its age when first asked, and when
        self._tasks: set[asyncio.Task[None]] = set()
        self.drilling, self.verifying, self.live = Drilling(self), Verifying(self), Live(self)

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

    # What is known.

    @property
    def decisions(self) -> Decisions:
        """What people decided, now."""
        return self.history.now

    @cached_property
    def patient(self) -> Patient | None:
        """Whom this case rehearses; None where its images are somebody's own."""
        entry = self.case.latest(Kind.CHANGED, where={"what": "rehearsal"})
        return None if entry is None else Patient.of(entry.content["to"])

    def seen(self, image: str) -> SeenImage | None:
        """What is known of an image, by its name; None where there is none."""
        number = self.decisions.images.get(image)
        return self.lightbox.image(number, None if number is None else self.decisions.mirrored.get(number))

    def views(self, names: tuple[str, str] = NAMES) -> tuple[BeadView, BeadView] | None:
        """Both views of a pair, once both are calibrated."""
        first, second = (None if seen is None else seen.view for seen in map(self.seen, names))
        return None if first is None or second is None else (first, second)

    @property
    def asks_mirrored(self) -> tuple[str, ...]:
        """Names of the planning images that show the frame mirrored where none shows it unmirrored: a person must say
        whether the display or the frame file is the cause; one answer is enough."""
        views = self.views()
        return NAMES if views is not None and all(view.mirrored for view in views) else ()

    @property
    def planned(self) -> Planned | None:
        """All that follows from the decisions; None until both views are calibrated."""
        views = self.views()
        if views is None:
            return None
        old = self._planned
        if old is None or old.decisions is not self.decisions or old.views != views:
            self._planned = planned(self.decisions, views)
        return self._planned

    def taken_at(self, seen: SeenImage) -> datetime | None:
        """When an image was taken: as its file says, else as a person says; None where neither does. A file that says a
        time after its arrival was written by a clock that is not this machine's, and says nothing."""
        arrived, said = seen.acquired.at, seen.taken_at
        if seen.acquired.by is Actor.DEMO:
            return arrived  # it was made for this
        if said is not None and said <= arrived + _CLOCKS_APART:
            return min(said, arrived)
        return self.decisions.taken.get(seen.acquired.number)

    @property
    def imaged_at(self) -> datetime | None:
        """When the older of the two planning images was taken; None where one is missing, or its time is not known."""
        at = [None if seen is None else self.taken_at(seen) for seen in map(self.seen, NAMES)]
        known = [one for one in at if one is not None]
        return min(known) if len(known) == len(NAMES) else None

    @property
    def age_s(self) -> float | None:
        """Of the plan: since its older image was taken. None where that is not known; negative where the clock was set
        back to before that. It grows with the time that passes here, even if the clock is set back meanwhile."""
        age, at = self._age_s(datetime.now(UTC)), self.imaged_at
        if age is None or at is None or age < 0.0:
            return age
        first, asked_s = self._aged.setdefault(at, (age, monotonic()))
        return max(age, first + monotonic() - asked_s)

    def _age_s(self, when: datetime) -> float | None:
        at = self.imaged_at
        return None if at is None else (when - at).total_seconds()

    @property
    def drilled_age_s(self) -> float | None:
        """How old the images were when the plan was sent that is drilled by now; None of another plan."""
        drilling = self.drilling
        if drilling.record is None or drilling.sent_at is None or not drilling.current:
            return None
        return self._age_s(drilling.sent_at)

    @property
    def fresh(self) -> bool:
        """True while the images are young enough to act on."""
        return _is_fresh(self.age_s)

    def verdict_of(self, known: Planned | None) -> Verdict | None:
        """All that stands for or against sending a plan: planning's checks, then what a person must confirm."""
        if known is None or known.plan is None:
            return None
        side, serial, _ = confirmations = self.confirmations
        given = ((side, self.decisions.side), (serial, self.decisions.serial))
        return known.plan.verdict.joined(
            Verdict(tuple(confirmations), tuple(check for check, value in given if value is None))
        )

    @property
    def verdict(self) -> Verdict | None:
        """Of the plan as it is now; None without one."""
        return self.verdict_of(self.planned)

    @property
    def go(self) -> bool:
        """True if there is a plan and every check passed."""
        verdict = self.verdict
        return verdict is not None and verdict.go

    @property
    def can_send(self) -> bool:
        """True if the plan is GO and its images are recent enough to act on, now."""
        return self.go and self.fresh

    @property
    def confirmations(self) -> list[Check]:
        """What a person must confirm before anything is sent, and the plan's age."""
        side, serial, known = self.decisions.side, self.decisions.serial, self.frame.serial
        drilled = self.drilled_age_s  # what is drilled grows no older
        age = self.age_s if drilled is None else drilled
        fresh = _is_fresh(age)
        return [
            Check(
                "side confirmed",
                side is not None,
                None,
                None,
                "",
                f"A person confirmed on the images that this is a {side} hip."
                if side
                else "Look at both images and confirm the patient's side, on the step Images.",
            ),
            Check(
                "frame confirmed",
                serial is not None and (known is None or serial == known),
                None,
                None,
                "",
                f"A person read the serial {serial} on the frame."
                if serial
                else "Read the serial on the frame that the robot holds and confirm it, on the step Images.",
            ),
            Check(
                "plan age",
                fresh,
                age,
                LIFETIME_S,
                "s",
                _age_sentence(age, fresh=fresh, drilled=drilled is not None),
            ),
        ]

    # What people do.

    def edit(self, decisions: Decisions) -> None:
        """Decide otherwise; in the journal when this returns. Raises CaseError."""
        if decisions != self.decisions:
            self._record("edit", decisions)
            self.history.edit(decisions)
            self.notify()

    def undo(self) -> None:
        """One change back."""
        if self.history.can_undo:
            self._record("undo", None)
            self.history.undo()
            self._reopen()

    def redo(self) -> None:
        """And forth again."""
        if self.history.can_redo:
            self._record("redo", None)
            self.history.redo()
            self._reopen()

    def moved(self, name: str, image: str, uv_px: Pixel, *, anew: bool = False) -> Decisions:
        """What moving a mark, or placing it `anew`, would come to. Raises what `snap` raises."""
        return moved(self.decisions, self.views() or (), name, image, uv_px, anew=anew)

    def remove(self, names: tuple[str, ...]) -> None:
        """Take marks away."""
        decisions = self.decisions
        for name in names:
            decisions = decisions.with_mark(name, None)
        self.edit(decisions)

    def choose_kind(self, kind: str) -> None:
        """Plan another kind of trajectory; marks that both kinds ask for stay."""
        self.edit(replace(self.decisions, kind=kind))

    def choose_snapping(self, on: bool) -> None:
        """Take lateral points of the wire to their curves from now on, or leave them where they are placed."""
        self.edit(replace(self.decisions, snapping=on))

    def confirm_side(self, side: Side | None) -> None:
        """A person saw on the images which side it is."""
        self.edit(replace(self.decisions, side=side))

    def confirm_serial(self, serial: str | None) -> None:
        """A person read the frame's serial. Raises UnusableInputError where it is another than the frame file's."""
        known = self.frame.serial
        if serial is not None and known is not None and serial != known:
            raise UnusableInputError(
                f"this case was calibrated with the frame {known}; if the robot holds another, open a case with that"
            )
        self.edit(replace(self.decisions, serial=serial))

    def state_taken(self, image: str, minutes_ago: float) -> None:
        """A person says when an image was taken. Raises UnusableInputError."""
        seen = self.seen(image)
        if seen is None or not (isfinite(minutes_ago) and 0.0 <= minutes_ago <= _LONGEST_AGO_MIN):
            raise UnusableInputError(TAKEN_REFUSED)
        at = datetime.now(UTC) - timedelta(minutes=minutes_ago)
        self.edit(self.decisions.with_taken(seen.acquired.number, at))

    def state_mirrored(self, image: str, backwards: bool) -> None:
        """A person says whether writing in an image reads backwards, as the page shows it.

        Raises UnusableInputError."""
        seen = self.seen(image)
        if seen is None or seen.view is None:
            raise UnusableInputError(MIRRORED_REFUSED)
        turned = self.decisions.display.get(image, Display()).mirrored  # the page's own mirror is none of the file's
        self.edit(self.decisions.with_mirrored(seen.acquired.number, backwards != turned))

    def show(self, image: str, display: Display) -> None:
        """Show an image otherwise."""
        self.edit(self.decisions.with_display(image, display))

    async def take(self, data: bytes, suffix: str, *, image: str, by: Actor = Actor.RADIOGRAPHER) -> str:
        """A new image; its datum markers tell which view it is, `image` only where they cannot be read. The name it was
        put under. Raises ImageError, CaseError."""
        check = image in CHECK_NAMES
        seen = await self.lightbox.acquire(data, suffix, by)
        name = image
        if seen.observations is not None:
            name = f"check-{seen.observations.view}" if check else seen.observations.view
        before = self.seen(name)
        same = before is not None and before.acquired.content["original"] == seen.acquired.content["original"]
        if same and by is not Actor.DEMO:
            return name  # the same file again is no new exposure: it is as old as it was
        self.edit(self.decisions.with_image(name, seen.acquired.number, same_pixels=same))
        return name

    def notify(self) -> None:
        """Tell every page; and measure the check shot anew where it is another. Called on the event loop."""
        if self.verifying.look():
            self._soon(self.verifying.measure())
        for listener in list(self.listeners):
            listener()

    # How the case is brought back.

    async def start(self) -> None:
        """Open the images that the decisions name; a rehearsal without images takes its first."""
        with suppress(SightlineError):  # pages show it as `trouble`
            await self.during("starting", lambda: self.workshop.do(warm_up))
            if self.patient is not None and not self.decisions.images:
                await self.take_rehearsed()
            if not self.decisions.images:
                await self._take_in()
        await self._open_named()

    async def _take_in(self) -> None:
        """The newest images that were acquired into this case otherwise, each placed by what its markers tell."""
        for entry in self.case.entries(Kind.ACQUIRED)[-_TAKEN_IN:]:
            with suppress(SightlineError):  # what is no image that can be calibrated is left to a person
                seen = await self.lightbox.open(entry)
                if seen.view is not None:
                    self.edit(self.decisions.with_image(seen.view.name, entry.number, same_pixels=False))

    async def take_rehearsed(self) -> None:
        """Both planning images of the rehearsed patient, anew."""
        patient = self.patient
        if patient is None:
            raise UnusableInputError("this case is no rehearsal: its images come from a C-arm")
        files = await self.during(
            "taking both images of the simulated patient", lambda: self.workshop.do(rehearsing.images, patient)
        )
        for name, data in files.items():
            await self.take(data, ".dcm", image=name, by=Actor.DEMO)

    async def during(self, what: str, work: Callable[[], Awaitable[T]]) -> T:
        """Begin some work and await it while pages say what it is; its SightlineError is shown and raised. Raises
        UnusableInputError while other work goes on, and begins nothing."""
        if self.working:
            raise UnusableInputError(f"{self.working} is not done yet; wait for it")
        self.working, self.trouble = what, ""
        self.notify()
        try:
            return await work()
        except SightlineError as error:
            self.trouble = str(error)
            raise
        except Exception as error:
            self.trouble = BUG.format(kind=type(error).__name__)
            raise
        finally:
            self.working = ""
            self.notify()

    def _reopen(self) -> None:
        self.notify()
        self._soon(self._open_named())

    def _soon(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)  # the loop itself holds it weakly
        task.add_done_callback(self._ended)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            traceback.print_exception(error)
            self.trouble = BUG.format(kind=type(error).__name__)
            self.notify()

    async def _open_named(self) -> None:
        for number in self.decisions.images.values():
            with suppress(SightlineError):
                await self.lightbox.open(self.case.entry(number))
        self.drilling.restore()
        self.notify()

    def _record(self, what: str, decisions: Decisions | None) -> None:
        to = None if decisions is None else decisions.document()
        stages.record_changed(self.case, what, to, by=Actor.SURGEON)


def _is_fresh(age_s: float | None) -> bool:
    return age_s is not None and 0.0 <= age_s <= LIFETIME_S


def _age_sentence(age_s: float | None, *, fresh: bool, drilled: bool) -> str:
    if age_s is None:
        return "It is not known when the images were taken: state it on the step Images, or take both again."
    if not fresh:
        return "The images are too old, or the clock was set back: the patient may have moved; take both again."
    if drilled:
        return "The images were recent enough when the plan was sent; the wire is drilled."
    return "The images are recent enough: the patient has not had long to move."
