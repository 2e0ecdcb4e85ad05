"""Planning on a case: its images, the decisions, and the resulting plan. Every decision is in the journal before a page
shows it."""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any, cast

import numpy as np

from sightline.app import texts
from sightline.app.plan.decisions import HEAD, NECK, SHAFT, Decisions, Display, History, Pixel, as_fitted
from sightline.app.plan.found_bone import BoneInViews, FoundBone
from sightline.app.plan.marks import MarkSpec
from sightline.app.plan.planner import (
    ROBOT_WIRE,
    HolesFound,
    Planned,
    drawn_axis,
    drawn_head,
    fitted_head,
    moved,
    nail_drawn,
    picks_of,
    planned,
    request_of,
)
from sightline.app.session import rehearsing
from sightline.app.session.jobs import Jobs, WorkerProcess, warm_up
from sightline.app.session.rehearsing import Patient
from sightline.app.session.seen import DrawnOn, Lightbox, NailInImages, SeenImage, entry_of
from sightline.app.session.sent import DrilledWire, SentPlan, restored
from sightline.calibration import BeadView
from sightline.calibration.solids.calibrate_together import adjusted_together
from sightline.case import stages
from sightline.case.journal import Actor, Case, Kind
from sightline.case.views import ALL_NAMES, NAMES, OBLIQUE, ImageSlot, takes_oblique
from sightline.errors import CalibrationRefusedError, CaseError, SightlineError, UnusableInputError
from sightline.from_images.head_and_shaft import fit_head, fit_shaft
from sightline.from_images.neck import fit_neck
from sightline.from_images.pipeline import DrillingOrder, propose_order
from sightline.planning import Circle, Line, Nail, WirePlans, kind
from sightline.planning.procedures.procedure import document_of, each_wire

_MAX_TAKEN_IN = 8  # [ours] newest images that are tried when a case has none assigned to views: each takes a second
_EDITS = ("edit", "undo", "redo")
_FITS: dict[str, Callable[..., Any]] = {HEAD: fit_head, SHAFT: fit_shaft, NECK: fit_neck}
_DRAW_FIRST = {
    HEAD: "click three points on the head's rim in both calibrated images first",
    SHAFT: "click two points on each border of the shaft in both calibrated images first",
    NECK: "click two points on each border of the neck in both calibrated images first, from the head past its "
    "narrowest place",
}
PICKS = "picks.json"  # beside the journal


class Planning:
    """Images, decisions and plan of one case. `all_sent`: the plans that were sent to the robot, `all_drilled`: the
    wires that are drilled to their depth, both by the wire's kind. `implanted`: the nail of a rehearsed patient, once
    it is known; `lacking_in`: what that patient lacks, by procedure. The listeners of `jobs` are called on every
    change. Raises UnusableInputError where the procedure of the decisions is not found."""

    def __init__(self, case: Case, frame_ref: str, worker: WorkerProcess, jobs: Jobs) -> None:
        self.case, self.frame, self.worker, self.jobs = case, stages.frame_of(case, frame_ref), worker, jobs
        self.lightbox = Lightbox(case, frame_ref, worker, jobs.notify)
        changes = [entry.content for entry in case.entries(Kind.CHANGED) if entry.content["what"] in _EDITS]
        self.history = History(
            (change["what"], None if change["to"] is None else Decisions.of(change["to"])) for change in changes
        )
        kind(self.decisions.kind)  # its file may be gone: then the page could not be built
        self.all_sent: dict[str, SentPlan] = {}
        self.all_drilled: dict[str, DrilledWire] = {}
        self.nail = NailInImages(lambda: self._drawn_on(self.decisions), jobs)
        self.implanted: Nail | None = None
        self.lacking_in: Mapping[str, str] = {}
        jobs.listeners.append(self.nail.update)
        self._planned: Planned | None = None
        self._kept: Planned | None = None
        self._order: tuple[WirePlans, DrillingOrder] | None = None

    # State.

    @property
    def decisions(self) -> Decisions:
        """The current decisions."""
        return self.history.now

    @cached_property
    def patient(self) -> Patient | None:
        """The rehearsed patient; None if the images come from a C-arm."""
        entry = self.case.latest(Kind.CHANGED, where={"what": "rehearsal"})
        return None if entry is None else Patient.of(entry.content["to"])

    @property
    def lacking(self) -> str:
        """What the chosen procedure needs and the rehearsed patient does not have; empty where there is no such thing.
        Of a file of the user's only a nail is known to be needed."""
        document, lacking = kind(self.decisions.kind).document, self.lacking_in
        nail = rehearsing.NAIL if document.through_holes and rehearsing.NAIL in lacking.values() else ""
        return lacking.get(document.key, nail)

    @property
    def specs(self) -> tuple[MarkSpec, ...]:
        """The marks that the page asks for, in order: those of the decisions, and the robot's own wire where the images
        show it, which those of an intensifier have no room for."""
        frame, own = self.frame, self.decisions.specs
        shown = self.patient is not None and frame.solid is not None and frame.detector is None
        return (*own, *ROBOT_WIRE) if shown else own

    @property
    def asked(self) -> tuple[MarkSpec, ...]:
        """Those of `specs` that a plan needs: no aids, and the robot's wire where its encoders alone are not accurate
        enough."""
        left_out = ("aid",) if self.decisions.of_nail else ("aid", "robot")
        return tuple(spec for spec in self.specs if spec.group not in left_out)

    @property
    def landmarks(self) -> tuple[MarkSpec, ...]:
        """The landmarks of the plan: those that are placed in PA and lateral image, which later images find again."""
        decisions = self.decisions
        return tuple(
            spec for spec in decisions.specs if spec.group == "landmark" and decisions.mark(spec.name).complete()
        )

    def seen(self, image: str) -> SeenImage | None:
        """Return the state of an image, by its name; None if there is none."""
        decisions = self.decisions
        number = decisions.images.get(image)
        return None if number is None else self.lightbox.image(number, decisions.mirrored.get(number))

    @cached_property
    def slots(self) -> tuple[str, ...]:
        """Names of the planning images that the frame can be seen in: PA, lateral, of a block also a third."""
        return ALL_NAMES if takes_oblique(self.frame) else NAMES

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the images that the plan is made on: PA, lateral, and the third once it is calibrated."""
        third = self.seen(OBLIQUE)
        return NAMES if third is None or third.view is None else ALL_NAMES

    def views(self, names: tuple[str, ...] | None = None) -> tuple[BeadView, ...] | None:
        """Return the views of the images `names`, by default those of the plan; None until all are calibrated.

        Views of a solid are adjusted together; those that contradict each other are returned as they are, and the plan
        is refused.
        """
        each = [None if seen is None else seen.view for seen in map(self.seen, names or self.names)]
        known = [view for view in each if view is not None]
        return _together(*known) if len(known) == len(each) else None

    def _drawn_on(self, decisions: Decisions) -> DrawnOn | None:
        """Return the nail as drawn, and the images of the plan; None until it is drawn and they are calibrated."""
        drawn = nail_drawn(decisions)
        if drawn is None:
            return None
        seen = [image for image in map(self.seen, self.names) if image is not None]
        views = tuple(image.view for image in seen if image.view is not None)
        return (drawn, views, tuple(image.image for image in seen)) if len(views) == len(self.names) else None

    @property
    def accepted_bone(self) -> FoundBone | None:
        """The bone's pose that a person accepted; None without one, and for other images than it was found in.

        Raises CaseError."""
        return self._accepted_in(self.decisions)

    def _accepted_in(self, decisions: Decisions) -> FoundBone | None:
        found = None if decisions.bone is None else _found_bone(self.case, decisions.bone)
        return found if found is not None and self.shows(found) else None

    def shows(self, bone: FoundBone) -> bool:
        """Return True if a bone was registered in the images of the plan, and in no others."""
        return dict(bone.images) == {name: self.decisions.images.get(name) for name in self.names}

    @property
    def bone(self) -> BoneInViews | None:
        """The accepted bone in the views that it was registered to; None without one."""
        return self._bone_of(self.decisions)

    def _bone_of(self, decisions: Decisions) -> BoneInViews | None:
        accepted = self._accepted_in(decisions)
        if accepted is None:
            return None
        views = [seen.view for seen in map(self.seen, self.names) if seen is not None]
        return BoneInViews(accepted.registered, tuple(view for view in views if view is not None))

    @property
    def asks_mirrored(self) -> tuple[str, ...]:
        """Names of the planning images if all show the frame mirrored, else empty. A person must then say whether the
        display or the frame file is the cause; one answer is enough."""
        seen = [image.view for image in map(self.seen, self.names) if image is not None and image.view is not None]
        return self.names if len(seen) == len(self.names) and all(view.mirrored for view in seen) else ()

    @property
    def planned(self) -> Planned | None:
        """The results of the decisions; None until both views are calibrated."""
        views = self.views()
        if views is None:
            return None
        old = self._planned
        holes = self.nail.found
        if old is None or old.decisions is not self.decisions or old.views != views or old.holes is not holes:
            self._planned = planned(self.decisions, views, holes, self.bone)
        return self._planned

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of all wires of the procedure."""
        return tuple(wire.key for wire in each_wire(kind(self.decisions.kind).document))

    @property
    def drilling_order(self) -> DrillingOrder | None:
        """The proposed order of drilling, once two wires or more are planned."""
        known = self.planned
        wires = None if known is None else known.wires
        if known is None or wires is None or len(wires.plans) < 2:
            return None
        if self._order is None or self._order[0] is not wires:
            self._order = wires, propose_order(wires.lines, wires.procedure, known.views, self.frame, wires.placed)
        return self._order[1]

    @property
    def sent(self) -> SentPlan | None:
        """The plan of the current wire that was sent to the robot."""
        return self.all_sent.get(self.decisions.kind)

    @property
    def drilled(self) -> DrilledWire | None:
        """The current wire, once it is drilled."""
        return self.all_drilled.get(self.decisions.kind)

    @property
    def sent_is_current(self) -> bool:
        """True while the current wire's plan is the one that was sent."""
        return self.sent is not None and self.sent.holds_for(self.decisions)

    # Actions of people.

    def edit(self, decisions: Decisions) -> None:
        """Change the decisions; the change is in the journal when this returns. Raises CaseError."""
        if decisions != self.decisions:
            self._record("edit", decisions)
            self.history.edit(decisions)
            self.jobs.notify()

    def decide(self, **news: Any) -> None:
        """Change members of the decisions, as of `edit`."""
        self.edit(replace(self.decisions, **news))

    def undo(self) -> None:
        """Undo one change."""
        if self.history.can_undo:
            self._record("undo", None)
            self.history.undo()
            self._reopen()

    def redo(self) -> None:
        """Redo one change."""
        if self.history.can_redo:
            self._record("redo", None)
            self.history.redo()
            self._reopen()

    def moved(self, name: str, image: str, uv_px: Pixel, *, anew: bool = False) -> Decisions:
        """Return the decisions after moving a mark, or placing it `anew`. Raises what `snap` raises."""
        return moved(self.decisions, self.views() or (), name, image, uv_px, anew=anew)

    def remove(self, names: tuple[str, ...]) -> None:
        """Remove marks."""
        decisions = self.decisions
        for name in names:
            decisions = decisions.with_mark(name, None)
        self.edit(decisions)

    def propose_others(self) -> None:
        """Place the other wires of a triangle beside its lowest one; drilled ones stay. Raises SightlineError."""
        known = self.planned
        if known is not None:
            self.edit(known.with_others_proposed(self.all_drilled))

    async def fit(self, key: str) -> None:
        """Fit a drawn aid, HEAD, SHAFT or NECK, to the edges of the images, as one change that can be undone.

        The neck is fitted from the head's centre as it is drawn or fitted now. Raises UnusableInputError where no image
        shows a clear edge, or the drawing has changed meanwhile."""
        before, views, head = self.decisions, self.views(NAMES), fitted_head(self.decisions)
        drawn = drawn_head(before) if key == HEAD else drawn_axis(before, key)
        if key == NECK and head is None:
            raise UnusableInputError(f"{_DRAW_FIRST[HEAD]}: the neck's axis begins at its centre")
        if drawn is None or views is None:
            raise UnusableInputError(_DRAW_FIRST[key])
        images = [seen.image for seen in map(self.seen, NAMES) if seen is not None]
        given = (head,) if key == NECK and head is not None else ()
        fitted, kept = await self.jobs.during(
            f"fitting the {key} to its edges", lambda: asyncio.to_thread(_FITS[key], views, images, drawn, *given)
        )
        if len(kept) == len(NAMES):
            raise UnusableInputError(" ".join(kept_as_drawn(kept)))
        now, member = self.decisions, f"fitted_{key}"
        drawn_now = drawn_head(now) if key == HEAD else drawn_axis(now, key)
        same = now.images == before.images and getattr(now, member) == getattr(before, member)
        if not same or not _same(drawn, drawn_now) or (given and not _same(given[0], fitted_head(now))):
            also = ", the head" if key == NECK else ""
            raise UnusableInputError(f"fit the {key} again: its drawing{also} or an image has changed meanwhile")
        ended = {"fitted_neck": None} if key == HEAD else {}
        self.decide(**{member: as_fitted(fitted, kept), **ended})

    def confirm_serial(self, serial: str) -> None:
        """Confirm the serial read on the frame. Raises UnusableInputError if the frame file states another."""
        known = self.frame.serial
        if known is not None and serial != known:
            raise UnusableInputError(
                f"check the frame: this case was calibrated with {known}; if the robot holds another one, open a case "
                f"for that frame"
            )
        self.decide(serial=serial)

    def state_mirrored(self, image: str, backwards: bool) -> None:
        """Record a person's statement whether writing in an image, as the page shows it, reads backwards.

        Raises UnusableInputError."""
        seen = self.seen(image)
        if seen is None or seen.view is None:
            raise UnusableInputError("wait until the image is calibrated, then answer")
        flipped = self.decisions.display.get(image, Display()).mirrored  # by the page, not in the file
        self.decide(mirrored={**self.decisions.mirrored, seen.acquired.number: backwards != flipped})

    async def take(self, data: bytes, suffix: str, *, image: str, by: Actor = Actor.RADIOGRAPHER) -> str:
        """Add a new image and return the name it was assigned to. The datum markers of plates determine the view;
        `image` is used if they cannot be read, and for a solid. Raises ImageError, CaseError."""
        slot = ImageSlot.read(image)
        seen = await self.lightbox.open(await self.lightbox.store(data, suffix, by), slot.view)
        name = slot if seen.observations is None else ImageSlot(seen.observations.view, slot.purpose)
        before = self.seen(name)
        same = before is not None and before.acquired.content["original"] == seen.acquired.content["original"]
        if same and by is not Actor.DEMO:
            return name  # the same file again is not a new exposure, so it keeps its age
        self.edit(self.decisions.with_image(name, seen.acquired.number, same_pixels=same))
        return name

    def keep_plan(self) -> None:
        """Record the plan in the case as the command line does, once. One that was sent is recorded already. Raises
        CaseError."""
        known = self.planned
        made = None if known is None else known.wires or known.plan
        if known is None or made is None or self.all_sent or known is self._kept:
            return
        views = [entry_of(self.case, seen) for seen in map(self.seen, self.names) if seen is not None]
        stages.record_plans(
            self.case, views, request_of(known.decisions, len(views), known.bone), made, by=Actor.SURGEON
        )
        self.write_picks(known.decisions)
        self._kept = known

    def write_picks(self, decisions: Decisions) -> None:
        """Write `picks.json` beside the journal: the picks of a plan, as `sightline plan --picks` takes them. Raises
        CaseError."""
        try:
            (self.case.folder / PICKS).write_text(picks_of(decisions, self.names).text, "utf-8")
        except OSError as error:
            raise CaseError(f"{PICKS} cannot be written beside the journal: {error.strerror}") from error

    # Opening of a case.

    def begin(self) -> None:
        """Start ahead of `start` what it waits for longest: the images of a rehearsal without any."""
        if self.patient is not None and not self.decisions.images:
            self.worker.begin(rehearsing.images, self.patient)

    async def start(self) -> None:
        """Open the images named in the decisions; a rehearsal without images acquires them."""
        with suppress(SightlineError):  # pages show it as `jobs.trouble`
            await self.jobs.during(
                "starting; the first start of a version compiles for a minute", lambda: self.worker.do(warm_up)
            )
            if self.patient is not None and not self.decisions.images:
                await self.take_rehearsed()
            if self.patient is not None and document_of(self.patient.procedure).through_holes:
                self.implanted = await self.worker.do(rehearsing.nail_of, self.patient)
            if not self.decisions.images:
                await self._take_in()
        await self._open_named()
        if self.patient is not None:  # last: it imports the twin, which images that are there do not need
            self.lacking_in = await self.worker.do(rehearsing.lacking_in, self.patient)
            self.jobs.notify()

    async def _take_in(self) -> None:
        """Assign the newest images that were acquired into this case by other programs, each by its datum markers, of a
        solid by the angles in its file."""
        for entry in self.case.entries(Kind.ACQUIRED)[-_MAX_TAKEN_IN:]:
            with suppress(SightlineError):  # leave an image that cannot be calibrated to a person
                seen = await self.lightbox.open(entry)
                if seen.view is not None:
                    self.edit(self.decisions.with_image(seen.view.name, entry.number, same_pixels=False))

    async def take_rehearsed(self, names: tuple[str, ...] = NAMES) -> None:
        """Acquire planning images of the rehearsed patient, by default PA and lateral."""
        patient = self.patient
        if patient is None:
            raise UnusableInputError("take the images with the C-arm: this case is not a rehearsal")
        files = await self.jobs.during(
            "taking images of the simulated patient", lambda: self.worker.do(rehearsing.images, patient, names)
        )
        for name, data in files.items():
            entry = await self.lightbox.store(data, ".dcm", Actor.DEMO)
            self.edit(self.decisions.with_image(name, entry.number, same_pixels=False))
        await self._open_named()

    def _reopen(self) -> None:
        self.jobs.notify()
        self.jobs.start(self._open_named())

    async def _open_named(self) -> None:
        named = tuple(self.decisions.images.items())
        for _, number in named:  # all are on the screen before the first is calibrated
            with suppress(SightlineError):
                await self.lightbox.show(self.case.entry(number))
        for name, number in named:
            with suppress(SightlineError):
                await self.lightbox.open(self.case.entry(number), ImageSlot.read(name).view)
        await self._restore_sent()
        self.jobs.notify()

    async def _restore_sent(self) -> None:
        views = self.views()
        if views is None or self.all_sent:
            return
        try:
            before = await asyncio.to_thread(restored, self.case, self.decisions, views, self._holes_of, self._bone_of)
        except SightlineError as error:
            self.jobs.trouble = str(error)
            return
        if self.all_sent:  # meanwhile a plan was sent
            return
        self.all_sent = {kind: sent for kind, (sent, _) in before.items()}
        self.all_drilled = {kind: drilled for kind, (_, drilled) in before.items() if drilled is not None}

    def _holes_of(self, decisions: Decisions) -> HolesFound | None:
        drawn = self._drawn_on(decisions)
        return None if drawn is None else HolesFound.find(*drawn)

    def _record(self, what: str, decisions: Decisions | None) -> None:
        to = None if decisions is None else decisions.document()
        stages.record_changed(self.case, what, to, by=Actor.SURGEON)


def kept_as_drawn(kept: Mapping[str, str]) -> list[str]:
    """Return a sentence for each view whose circle was kept, from the reasons by view."""
    return [f"{texts.DROP_LABELS[view]}: kept as drawn; {why}." for view, why in kept.items()]


def _same(first: Sequence[Circle | Line], second: Sequence[Circle | Line] | None) -> bool:
    """Return True if circles or lines go through the same pixels."""
    return second is not None and all(
        np.array_equal(_drawn_px(a), _drawn_px(b)) for a, b in zip(first, second, strict=True)
    )


def _drawn_px(drawn: Circle | Line) -> np.ndarray:
    """Return the clicks of a circle or of a line between borders."""
    borders = drawn.borders_px if isinstance(drawn, Line) else None
    return drawn.uv_px if borders is None else borders


@lru_cache(maxsize=4)
def _found_bone(case: Case, number: int) -> FoundBone:
    return FoundBone.of(case.entry(number).content["to"])


@lru_cache(maxsize=4)  # planning and check images, before and after a change
def _together(*views: BeadView) -> tuple[BeadView, ...]:
    try:
        return cast("tuple[BeadView, ...]", adjusted_together(views))
    except CalibrationRefusedError:
        return views
