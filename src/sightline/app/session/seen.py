"""Processing of an image of the case, from its file to a calibrated view, and the search for a nail in the images."""

import asyncio
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from typing import TypeAlias

from sightline.app.plan.planner import NAIL, HolesFound
from sightline.app.session.jobs import Jobs, WorkerProcess, report, sentence_of
from sightline.calibration import BeadView
from sightline.case import stages
from sightline.case.journal import Actor, Case, Entry
from sightline.case.views import CalibratedImage, ObservedView, calibrated
from sightline.detection import Detections, Observations
from sightline.errors import CaseError, SightlineError
from sightline.from_images.interlocking import NailDrawn
from sightline.from_images.pipeline import find_beads, known_arm, label_beads
from sightline.imaging import Radiograph, taken_at

WAITING = "waiting"  # stage of an image that is shown and not yet processed


@dataclass(frozen=True, eq=False)
class SeenImage:
    """State of one acquired image. `doing`: the current stage, empty if none. `refused`: why processing ended early.
    `taken_at`: time of acquisition from the file; None if not stated. The later members are set stage by stage."""

    acquired: Entry
    image: Radiograph
    doing: str = ""
    refused: str | None = None
    taken_at: datetime | None = None
    beads: Detections | None = None
    observations: Observations | None = None
    view: BeadView | None = None

    @property
    def calibrated(self) -> CalibratedImage | None:
        """The result for reports and exports; its source is the image's number in the case, never a file name."""
        if self.view is None or self.observations is None:
            return None
        return CalibratedImage(self.labelled_as(self.observations), self.view)

    def labelled_as(self, observations: Observations) -> ObservedView:
        """Return this image with observations that may be others than its own."""
        return ObservedView(f"image {self.acquired.number}", observations, self.image, self.beads)

    def said_to_be(self, mirrored_display: bool | None) -> "SeenImage":
        """Return the image with a person's statement whether its display is mirrored; the same object for the same
        answer."""
        return self if self.view is None or mirrored_display is None else self._said[mirrored_display]

    @cached_property
    def _said(self) -> "dict[bool, SeenImage]":
        assert self.view is not None  # noqa: S101 - the question is asked only then
        return {answer: replace(self, view=self.view.said_to_be(answer)) for answer in (False, True)}


class Lightbox:
    """The images of a case, by the number of their entry, processed one after another; `changed` is called after each
    stage."""

    def __init__(self, case: Case, frame_ref: str, worker: WorkerProcess, changed: Callable[[], None]) -> None:
        self._case, self._workshop, self._changed = case, worker, changed
        self._frame_ref, self._frame = frame_ref, stages.frame_of(case, frame_ref)
        self._images: dict[int, SeenImage] = {}

    def image(self, number: int, mirrored_display: bool | None = None) -> SeenImage | None:
        """Return the state of an image; None if it is not open. `mirrored_display`: a person's statement."""
        known = self._images.get(number)
        return None if known is None else known.said_to_be(mirrored_display)

    async def store(self, data: bytes, suffix: str, by: Actor) -> Entry:
        """Store a new image in the case and return its entry. Raises ImageError, CaseError."""
        return await asyncio.to_thread(stages.record_acquired, self._case, data, suffix, by=by)

    async def show(self, entry: Entry) -> SeenImage:
        """Return the state of an image of the case, which is read if it is new, so that pages can show it."""
        known = self._images.get(entry.number)
        if known is None:
            image = await asyncio.to_thread(stages.image_of, self._case, entry)
            taken = await asyncio.to_thread(taken_at, self._case.original(entry.content["original"]))
            known = SeenImage(entry, image, doing=WAITING, taken_at=taken)
            self._put(known)
        return known

    async def open(self, entry: Entry, view: str | None = None) -> SeenImage:
        """Process an image of the case; results that the journal lacks are recorded.

        `view`: which one it is according to a person, which counts for a solid; plates tell it themselves. None: as it
        was labelled before, or as its file states (`stages.view_of_acquired`).
        """
        known = await self.show(entry)
        if known.doing != WAITING and known.refused is None:
            return known
        solid = self._frame.solid is not None
        named = (view or stages.view_of_acquired(self._case, entry, known.image)) if solid else None
        try:
            await self._work(SeenImage(entry, known.image, taken_at=known.taken_at), named)
        except Exception as error:
            self._put(replace(self._images[entry.number], doing="", refused=sentence_of(error)))
            if not isinstance(error, SightlineError):
                raise
        return self._images[entry.number]

    async def _work(self, seen: SeenImage, view: str | None) -> None:
        case, frame = self._case, self._frame
        self._put(replace(seen, doing="finding the beads"))
        image, beads = await self._workshop.do(find_beads, seen.image)
        seen = replace(seen, doing="labelling the beads", beads=beads)
        seen = replace(seen, image=image) if image.is_inverted else seen  # otherwise its picture is already shown
        self._put(seen)
        observations = await self._workshop.do(label_beads, image, beads, frame, view)
        seen = replace(seen, doing="calibrating", observations=observations)
        self._put(seen)
        result = await self._workshop.do(calibrated, seen.labelled_as(observations), frame, "smooth", known_arm(image))
        number = seen.acquired.number
        before = {n: other.view for n, other in self._images.items() if n < number and other.view is not None}
        steady = await asyncio.to_thread(result.view.steady_since, list(before.values()))
        done = replace(seen, doing="", view=steady)
        await asyncio.to_thread(_record, case, done, self._frame_ref, list(before))
        self._put(done)

    def _put(self, seen: SeenImage) -> None:
        self._images[seen.acquired.number] = seen
        self._changed()


def entry_of(case: Case, seen: SeenImage) -> Entry:
    """Return the calibrated entry of an image, recorded anew if a person's statement on its display has changed. Raises
    CaseError."""
    assert seen.calibrated is not None  # noqa: S101 - it is calibrated
    entry = stages.calibrated_of(case, seen.acquired.number)
    if entry.settings.get("mirrored_display") == seen.calibrated.view.mirrored_display:
        return entry
    labelled, before = case.entry(entry.rests_on[0]), entry.settings.get("before", ())
    return stages.record_calibrated(case, labelled, seen.calibrated, by=Actor.APP, before=before)


def _record(case: Case, seen: SeenImage, frame_ref: str, before: Sequence[int]) -> None:
    """Record the results. `before`: numbers of the images that the view was compared with."""
    with suppress(CaseError):
        stages.calibrated_of(case, seen.acquired.number)
        return  # already recorded
    assert seen.beads is not None and seen.observations is not None and seen.calibrated is not None  # noqa: S101
    inverted = seen.image.is_inverted
    detected = stages.record_detected(case, seen.acquired, seen.beads, by=Actor.APP, inverted=inverted)
    view = stages.named_view(case, frame_ref, seen.observations)
    labelled = stages.record_labelled(case, detected, seen.observations, frame_ref=frame_ref, by=Actor.APP, view=view)
    held = [stages.calibrated_of(case, acquired).number for acquired in before]
    stages.record_calibrated(case, labelled, seen.calibrated, by=Actor.APP, before=held)


DrawnOn: TypeAlias = tuple[NailDrawn, tuple[BeadView, ...], tuple[Radiograph, ...]]


class NailInImages:
    """What the images show of the nail as drawn. `searching`: it is being looked for."""

    def __init__(self, drawn_on: Callable[[], DrawnOn | None], jobs: Jobs) -> None:
        """`drawn_on`: returns the nail as it is drawn now, and the calibrated images; None without one."""
        self._drawn_on, self._jobs = drawn_on, jobs
        self._found: HolesFound | None = None
        self.searching = False

    @property
    def found(self) -> HolesFound | None:
        """What was found of the nail as it is drawn now; None while it is searched for, and without one."""
        newest, now = self._found, self._drawn_on()
        return newest if newest is not None and now is not None and newest.is_of(*now[:2]) else None

    def update(self) -> None:
        """Start the search where the nail as drawn was not looked for. Must run on the event loop."""
        if not self.searching and self.found is None and (now := self._drawn_on()) is not None:
            self.searching = True
            self._jobs.start(self._search(now))

    async def _search(self, now: DrawnOn) -> None:
        try:
            self._found = await asyncio.to_thread(HolesFound.find, *now, self._found)
        except Exception as error:  # a defect; searching again would not help
            self._found = HolesFound(*now, refused={NAIL: report(error)})
        self.searching = False
        self._jobs.notify()  # and again, if it was drawn differently meanwhile
