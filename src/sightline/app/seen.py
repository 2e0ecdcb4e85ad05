"""An image of the case on its way from a file to a calibrated view, and the work that takes it there."""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime

from sightline.app.texts import BUG
from sightline.app.workshop import Workshop
from sightline.calibration import BeadView, calibrate
from sightline.case import stages
from sightline.case.entry import Actor, Entry
from sightline.case.journal import Case
from sightline.case.views import CalibratedImage, Seen, tell_apart
from sightline.detection import Detections, Observations, detect
from sightline.errors import CaseError, SightlineError
from sightline.frame import Frame
from sightline.imaging import Radiograph, taken_at


@dataclass(frozen=True, eq=False)
class SeenImage:
    """What is known so far of one acquired image. `doing`: what is being done now, empty at rest. `refused`: why it
    goes no further. `taken_at`: when the image was taken, as its file says; None where it does not. Each later member
    is there once the work has come so far."""

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
        """As reports and exports want it; its source is the image's number in the case, never a file's name."""
        if self.view is None or self.observations is None:
            return None
        return CalibratedImage(
            Seen(f"image {self.acquired.number}", self.observations, self.image, self.beads), self.view
        )


class Lightbox:
    """The images of a case by the number of their entry, worked on one after another; `changed` is called as they
    get further."""

    def __init__(self, case: Case, frame_ref: str, workshop: Workshop, changed: Callable[[], None]) -> None:
        self._case, self._workshop, self._changed = case, workshop, changed
        self._frame_ref, self._frame = frame_ref, stages.frame_of(case, frame_ref)
        self._images: dict[int, SeenImage] = {}

    def image(self, number: int | None) -> SeenImage | None:
        """What is known of an image; None where it is not open."""
        return None if number is None else self._images.get(number)

    async def acquire(self, data: bytes, suffix: str, by: Actor) -> SeenImage:
        """Keep a new image in the case and work on it to the end. Raises ImageError, CaseError."""
        entry = await asyncio.to_thread(stages.record_acquired, self._case, data, suffix, by=by)
        return await self.open(entry)

    async def open(self, entry: Entry) -> SeenImage:
        """Work on an image of the case to the end; the results go into the journal where it does not hold them yet."""
        known = self._images.get(entry.number)
        if known is not None and known.refused is None:
            return known
        image = await asyncio.to_thread(stages.image_of, self._case, entry)
        taken = await asyncio.to_thread(taken_at, self._case.original(entry.content["original"]))
        try:
            await self._work(SeenImage(entry, image, taken_at=taken))
        except SightlineError as error:
            self._put(replace(self._images[entry.number], doing="", refused=str(error)))
        except Exception as error:
            refused = BUG.format(kind=type(error).__name__)
            self._put(replace(self._images[entry.number], doing="", refused=refused))
            raise
        return self._images[entry.number]

    async def _work(self, seen: SeenImage) -> None:
        case, frame, number = self._case, self._frame, seen.acquired.number
        self._put(replace(seen, doing="finding the beads"))
        beads = await self._workshop.do(detect, seen.image)
        self._put(replace(self._images[number], doing="telling the beads apart", beads=beads))
        observations = await self._workshop.do(tell_apart, seen.image, beads, frame)
        self._put(replace(self._images[number], doing="calibrating", observations=observations))
        view = await self._workshop.do(calibrated, observations, frame)
        done = replace(self._images[number], doing="", view=view)
        await asyncio.to_thread(_record, case, done, self._frame_ref)
        self._put(done)

    def _put(self, seen: SeenImage) -> None:
        self._images[seen.acquired.number] = seen
        self._changed()


def calibrated(observations: Observations, frame: Frame) -> BeadView:
    """The view, by the default method."""
    return calibrate(observations, frame)


def _record(case: Case, seen: SeenImage, frame_ref: str) -> None:
    with suppress(CaseError):
        stages.calibrated_of(case, seen.acquired.number)
        return  # the same image, the same results
    assert seen.beads is not None and seen.observations is not None and seen.calibrated is not None  # noqa: S101
    detected = stages.record_detected(case, seen.acquired, seen.beads, by=Actor.APP)
    labelled = stages.record_labelled(case, detected, seen.observations, frame_ref=frame_ref, by=Actor.APP)
    stages.record_calibrated(case, labelled, seen.calibrated, by=Actor.APP)
