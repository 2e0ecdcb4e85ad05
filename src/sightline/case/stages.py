"""The stages of a procedure as entries of a case, each resting on those before: what `replay` computes again."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from sightline.bounded import read_bounded
from sightline.case import contents
from sightline.case.contents import Asked, CheckAsked
from sightline.case.journal import Actor, Case, Entry, Kind
from sightline.case.views import CalibratedImage
from sightline.detection import Detections, Observations
from sightline.errors import CaseError
from sightline.frame import Frame
from sightline.frame.builtin import BUILTIN
from sightline.imaging import Radiograph, read_image
from sightline.imaging.limits import MAX_FILE_BYTES
from sightline.planning import Plan
from sightline.planning.check_result import CheckShot

TABLE = ".csv"  # of beads, found by other software or by hand


def record_changed(case: Case, what: str, to: object, *, by: Actor) -> Entry:
    """Something about the case is another: its frame, its patient, what a person decided."""
    return case.record(Kind.CHANGED, {"what": what, "from": None, "to": to}, by=by)


def record_acquired(case: Case, data: bytes, suffix: str, *, by: Actor) -> Entry:
    """An image, or beads as CSV, as it came. The file's own name is not asked for: it may be a patient's.

    Raises CaseError, ImageError.
    """
    name = case.keep(data, suffix)
    image = None if suffix == TABLE else read_image(case.original(name))
    return case.record(Kind.ACQUIRED, contents.acquired(name, image), by=by, settings={"frame_index": None})


def image_of(case: Case, acquired: Entry) -> Radiograph:
    """The image of an entry of `record_acquired`, from its original. Raises CaseError, ImageError."""
    original, settings = case.original(acquired.content["original"]), acquired.settings
    return read_image(original, settings["frame_index"], invert=settings.get("inverted", False))


def record_detected(case: Case, acquired: Entry, beads: Detections, *, by: Actor, inverted: bool = False) -> Entry:
    """What `detect` found in the image, or in its inverse."""
    settings = {"inverted": True} if inverted else None
    return case.record(Kind.DETECTED, contents.detected(beads), by=by, rests_on=[acquired.number], settings=settings)


def keep_frame(case: Case, frame: Frame) -> str:
    """How entries name a frame: a built-in one by its name, another by the original that holds it.

    Raises FrameError for the mirror image of a frame of the same name and serial that the case has.
    """
    text = frame.to_json()
    if frame.name in BUILTIN and Frame.load(frame.name).to_json() == text:
        return frame.name
    frame.refuse_mirror_image(_frames_before(case))
    return case.keep(text, ".json")


def _frames_before(case: Case) -> Iterator[Frame]:
    """The frames that entries of a case name, those of files."""
    changed = (str(e.content["to"]) for e in case.entries(Kind.CHANGED) if e.content["what"] == "frame")
    named = {*changed, *(str(e.settings["frame"]) for e in case.entries(Kind.LABELLED))}
    yield from (frame_of(case, name) for name in sorted(named - BUILTIN.keys()))


def frame_of(case: Case, name: str) -> Frame:
    """The frame that `keep_frame` named so. Raises CaseError, FrameError."""
    return Frame.load(name if name in BUILTIN else case.original(name))


def record_labelled(
    case: Case,
    source: Entry,
    observations: Observations,
    *,
    frame_ref: str,
    by: Actor,
    view: str | None = None,
    datums: Mapping[str, tuple[float, float]] | None = None,
) -> Entry:
    """Beads told apart and looked at again, as `case.views.see` does; `view` and `datums` as given to `label`.

    `source`: the detected beads, or an acquired table that holds the observations. `frame_ref`: of `keep_frame`.
    """
    settings: dict[str, Any] = {"frame": frame_ref, "view": view, "datums": datums}
    content = contents.labelled(observations, frame_of(case, frame_ref).key)
    return case.record(Kind.LABELLED, content, by=by, rests_on=[source.number], settings=settings)


def record_calibrated(
    case: Case, labelled: Entry, image: CalibratedImage, *, by: Actor, before: Sequence[int] = ()
) -> Entry:
    """A view, calibrated from the observations of `labelled` by `calibrate` with its defaults. `before`: numbers of
    calibrated entries that it was held against (`BeadView.steady_since`)."""
    settings: dict[str, Any] = {"frame": labelled.settings["frame"], "method": image.view.method}
    if image.view.mirrored_display is not None:
        settings["mirrored_display"] = image.view.mirrored_display
    if image.view.c_arm is not None:
        settings["c_arm"] = vars(image.view.c_arm)
    if before:
        settings["before"] = list(before)
    return case.record(
        Kind.CALIBRATED, contents.calibrated(image), by=by, rests_on=[labelled.number], settings=settings
    )


def record_view(case: Case, file: Path, image: CalibratedImage, *, frame_ref: str, by: Actor) -> Entry:
    """Everything of one view, from its file to its geometry, as `case.views` makes it; the entry of the latter."""
    data = read_bounded(file, MAX_FILE_BYTES, CaseError, "export single images")
    acquired = record_acquired(case, data, file.suffix.lower(), by=by)
    return record_seen(case, acquired, image, frame_ref=frame_ref, by=by)


def record_seen(case: Case, acquired: Entry, image: CalibratedImage, *, frame_ref: str, by: Actor) -> Entry:
    """Record beads, labels and geometry of an acquired image, or table of beads; return the entry of the geometry."""
    seen, source = image.seen, acquired
    if seen.beads is not None:
        inverted = seen.image is not None and seen.image.is_inverted
        source = record_detected(case, source, seen.beads, by=by, inverted=inverted)
    labelled = record_labelled(case, source, seen.observations, frame_ref=frame_ref, by=by)
    return record_calibrated(case, labelled, image, by=by)


def record_planned(case: Case, views: tuple[Entry, Entry], asked: Asked, made: Plan, *, by: Actor) -> Entry:
    """A plan that `asked.plan` made on the calibrated views, PA first."""
    kinds = [view.kind for view in views]
    if kinds != [Kind.CALIBRATED, Kind.CALIBRATED]:
        raise CaseError(f"a plan rests on two calibrated views, not on {' and '.join(kinds)}")
    return case.record(Kind.PLANNED, contents.planned(asked, made), by=by, rests_on=[view.number for view in views])


def record_verified(
    case: Case, plan: Entry, views: tuple[Entry, Entry], asked: CheckAsked, found: CheckShot | str, *, by: Actor
) -> Entry:
    """A check shot that `asked.shot` measured in two more calibrated views, PA first, or why it refused."""
    rests_on = (plan, *views)
    kinds = [entry.kind for entry in rests_on]
    if kinds != [Kind.PLANNED, Kind.CALIBRATED, Kind.CALIBRATED]:
        raise CaseError(f"a check shot rests on a plan and two calibrated views, not on {', '.join(kinds)}")
    content = contents.verified(asked, found)
    return case.record(Kind.VERIFIED, content, by=by, rests_on=[entry.number for entry in rests_on])


def acquired_of(case: Case, entry: Entry) -> Entry:
    """The acquired entry that one of an image goes back to; it may be that itself."""
    while entry.kind is not Kind.ACQUIRED:
        entry = case.entry(entry.rests_on[0])
    return entry


def calibrated_of(case: Case, acquired: int) -> Entry:
    """The last calibrated entry that goes back to the acquired one of this number. Raises CaseError."""
    for entry in reversed(case.entries(Kind.CALIBRATED)):
        if acquired_of(case, entry).number == acquired:
            return entry
    raise CaseError(f"the image of entry {acquired} was not calibrated in this case")
