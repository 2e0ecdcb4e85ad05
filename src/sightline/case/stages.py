"""The stages of a procedure as entries of a case, and the images that a plan or check shot is made on.

Each entry names those it was made from, so that `replay` can recompute it. Images are given files, or the newest of a
case: PA and lateral, for a plan also a third.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sightline.case import contents
from sightline.case.canonical import canonical, digest
from sightline.case.contents import CheckRequest, DrillShotRequest, Images, PlanRequest
from sightline.case.journal import Actor, Case, Entry, Kind
from sightline.case.journal.originals import name_of, short
from sightline.case.views import NAMES, CalibratedImage, ObservedView, see_oblique, see_pair, spoken, stated_view
from sightline.common.bounded import MAX_FILE_BYTES, read_bounded
from sightline.detection import Detections, Observations
from sightline.detection.csv_files import are_detections
from sightline.errors import CaseError, ImageError, RefusedError, UnusableInputError
from sightline.frame import Frame
from sightline.frame.designs import BUILTIN
from sightline.from_images.pipeline import find_beads, label_beads
from sightline.imaging import Radiograph, read_image
from sightline.planning import Plan, WirePlans
from sightline.planning.check.result import CheckShot
from sightline.planning.check.shot import DrillShot

TABLE = ".csv"  # suffix of a table of beads, found by other software or by hand


def record_changed(case: Case, what: str, to: object, *, by: Actor) -> Entry:
    """Record a change of the case: its frame, its patient, or what a person decided."""
    return case.record(Kind.CHANGED, {"what": what, "from": None, "to": to}, by=by)


def record_acquired(case: Case, data: bytes, suffix: str, *, by: Actor) -> Entry:
    """Keep and record an image, or beads as CSV. The file's own name is not recorded: it may be a patient's.

    Raises CaseError, ImageError.
    """
    name = case.keep(data, suffix)
    try:
        image = None if suffix == TABLE else read_image(case.original(name))
    except ImageError as error:  # a person knows the file by another name than the kept one
        raise ImageError(str(error).replace(case.original(name).name, "the file")) from error
    return case.record(Kind.ACQUIRED, contents.acquired(name, image), by=by, settings={"frame_index": None})


def image_of(case: Case, acquired: Entry) -> Radiograph:
    """Read the image of an acquired entry from its original. Raises CaseError, ImageError."""
    original, settings = case.original(acquired.content["original"]), acquired.settings
    return read_image(original, settings["frame_index"], invert=settings.get("inverted", False))


def record_detected(case: Case, acquired: Entry, beads: Detections, *, by: Actor, inverted: bool = False) -> Entry:
    """Record the beads that `detect` found in the image, or in its inverse."""
    settings = {"inverted": True} if inverted else None
    return case.record(Kind.DETECTED, contents.detected(beads), by=by, rests_on=[acquired.number], settings=settings)


def keep_frame(case: Case, frame: Frame) -> str:
    """Keep a frame and return the reference by which entries name it: a built-in frame's name, or an original's name.

    Raises FrameError if the case has a frame of the same name and serial that is a mirror image of this one.
    """
    text = frame.to_json()
    if frame.name in BUILTIN and Frame.load(frame.name).to_json() == text:
        return frame.name
    frame.refuse_mirror_image(_frames_before(case))
    return case.keep(text, ".json")


def _frames_before(case: Case) -> Iterator[Frame]:
    """Return the frames from files that entries of a case name."""
    changed = (str(e.content["to"]) for e in case.entries(Kind.CHANGED) if e.content["what"] == "frame")
    named = {*changed, *(str(e.settings["frame"]) for e in case.entries(Kind.LABELLED))}
    yield from (frame_of(case, name) for name in sorted(named - BUILTIN.keys()))


def frame_in_use(case: Case) -> str | None:
    """Return the reference of the frame that the case was last set to; None if it was never set. Raises CaseError."""
    entry = case.latest(Kind.CHANGED, where={"what": "frame"})
    return None if entry is None else str(entry.content["to"])


def frame_of(case: Case, name: str) -> Frame:
    """Return the frame of a reference from `keep_frame`. Raises CaseError, FrameError."""
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
    """Record beads that were labelled and measured again, as `case.views.see` does; `view`, `datums`: as for `label`.

    `source`: entry of the detected beads, or of an acquired table with the observations. `frame_ref`: see `keep_frame`.
    """
    settings: dict[str, Any] = {"frame": frame_ref, "view": view, "datums": datums}
    content = contents.labelled(observations, frame_of(case, frame_ref).key)
    return case.record(Kind.LABELLED, content, by=by, rests_on=[source.number], settings=settings)


def record_calibrated(
    case: Case, labelled: Entry, image: CalibratedImage, *, by: Actor, before: Sequence[int] = ()
) -> Entry:
    """Record a view calibrated from the observations of `labelled` by `calibrate` with its defaults.

    `before`: numbers of the calibrated entries that it was compared with (`BeadView.steady_since`).
    """
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
    """Record all stages of one view that `case.views` made, from its file on; return the calibrated entry."""
    data = read_bounded(file, MAX_FILE_BYTES, CaseError, "export single images")
    acquired = record_acquired(case, data, file.suffix.lower(), by=by)
    return record_seen(case, acquired, image, frame_ref=frame_ref, by=by)


def record_seen(case: Case, acquired: Entry, image: CalibratedImage, *, frame_ref: str, by: Actor) -> Entry:
    """Record beads, labels and geometry of an acquired image, or table of beads; return the entry of the geometry."""
    seen, source = image.seen, acquired
    if seen.beads is not None:
        inverted = seen.image is not None and seen.image.is_inverted
        source = record_detected(case, source, seen.beads, by=by, inverted=inverted)
    view = named_view(case, frame_ref, seen.observations)
    labelled = record_labelled(case, source, seen.observations, frame_ref=frame_ref, by=by, view=view)
    return record_calibrated(case, labelled, image, by=by)


def record_planned(case: Case, views: Sequence[Entry], asked: PlanRequest, made: Plan, *, by: Actor) -> Entry:
    """Record a plan that `asked.plan` made on the calibrated views, PA first. Raises CaseError."""
    kinds = [view.kind for view in views]
    if set(kinds) != {Kind.CALIBRATED} or len(kinds) < len(NAMES):
        raise CaseError(f"a plan rests on two calibrated views or more, not on {' and '.join(kinds)}")
    return case.record(Kind.PLANNED, contents.planned(asked, made), by=by, rests_on=[view.number for view in views])


def record_plans(
    case: Case, views: Sequence[Entry], asked: PlanRequest, made: Plan | WirePlans, *, by: Actor
) -> dict[str, Any]:
    """Record the plan of a wire, or of several, each in an entry of its own in the order of drilling.

    Returns the numbers: "entry", or "entries" by wire. Raises CaseError."""
    if isinstance(made, Plan):
        return {"entry": record_planned(case, views, asked, made, by=by).number}
    each = made.plans.items()
    return {"entries": {key: record_planned(case, views, asked.of_wire(key), plan, by=by).number for key, plan in each}}


def record_verified(
    case: Case, plan: Entry, views: Sequence[Entry], asked: CheckRequest, result: CheckShot | str, *, by: Actor
) -> Entry:
    """Record the check shot that `asked.shot` measured in two more calibrated views, PA first, or why it was refused.

    Raises CaseError.
    """
    return _record_measured(case, Kind.VERIFIED, (plan, *views), contents.shot(asked, result), by)


def record_shot(
    case: Case, plan: Entry, views: Sequence[Entry], asked: DrillShotRequest, result: DrillShot | str, *, by: Actor
) -> Entry:
    """Record a shot while drilling that `asked.shot` measured in two more calibrated views, or why it was refused."""
    return _record_measured(case, Kind.SHOT, (plan, *views), contents.shot(asked, result), by)


def _record_measured(case: Case, kind: Kind, rests_on: Sequence[Entry], content: dict[str, Any], by: Actor) -> Entry:
    kinds = [entry.kind for entry in rests_on]
    if kinds != [Kind.PLANNED, Kind.CALIBRATED, Kind.CALIBRATED]:
        raise CaseError(f"a check shot rests on a plan and two calibrated views, not on {', '.join(kinds)}")
    return case.record(kind, content, by=by, rests_on=[entry.number for entry in rests_on])


def acquired_of(case: Case, entry: Entry) -> Entry:
    """Return the acquired entry that `entry` was made from; it may be `entry` itself."""
    while entry.kind is not Kind.ACQUIRED:
        entry = case.entry(entry.rests_on[0])
    return entry


def named_view(case: Case, frame_ref: str, observations: Observations) -> str | None:
    """Return the view stated to label observations of a solid; None for plates, whose datum markers tell it."""
    return None if frame_of(case, frame_ref).solid is None else observations.view


def _made_from(case: Case, acquired: int, kind: Kind) -> Iterator[Entry]:
    """Yield the entries of a kind that were made from the acquired entry of this number, the newest first."""
    entries = reversed(case.entries(kind, acquired))
    return (entry for entry in entries if acquired_of(case, entry).number == acquired)


def view_of_acquired(case: Case, acquired: Entry, image: Radiograph) -> str | None:
    """Return the view that an acquired image was labelled as last, else what its file states (`stated_view`)."""
    labelled = next(_made_from(case, acquired.number, Kind.LABELLED), None)
    return stated_view(image) if labelled is None else str(labelled.content["view"])


def calibrated_of(case: Case, acquired: int) -> Entry:
    """Return the last calibrated entry made from the acquired entry of this number. Raises CaseError."""
    for entry in _made_from(case, acquired, Kind.CALIBRATED):
        return entry
    raise CaseError(f"the image of entry {acquired} was not calibrated in this case")


@dataclass(frozen=True, eq=False)
class SeenImages:
    """PA, lateral and any third image before calibration, and their `source`: files, or the entries that acquired them.

    `skipped`: newer images of the case that were not used, each with the reason.
    """

    seen: tuple[ObservedView, ...]
    source: tuple[Path | Entry, ...]
    skipped: tuple[str, ...] = ()


def given_images(files: Sequence[Path], frame: Frame, *, invert: bool = False) -> SeenImages:
    """Return the images, or tables of beads, of the files: PA, lateral, and a third where it is given.

    Raises what `see_pair` and `see_oblique` raise.
    """
    third = (see_oblique(path, frame, invert=invert) for path in files[2:])
    return SeenImages((*see_pair(files[0], files[1], frame, invert=invert), *third), tuple(files))


def newest_images(
    case: Case, frame: Frame, names: Sequence[str] = NAMES, *, after: int = 0, invert: bool = False
) -> SeenImages:
    """Return the newest image of each of the views `names` among the entries after number `after`.

    An image whose beads cannot be found or labelled is skipped, and one of a solid whose view is not known. `invert`:
    the balls are bright. Raises CaseError if a view has no image.
    """
    newest: dict[str, tuple[Entry, ObservedView]] = {}
    skipped: list[str] = []
    for entry in reversed(case.entries(Kind.ACQUIRED, after)):
        if entry.content["original"].endswith(TABLE) or newest.keys() >= set(names):
            continue
        try:
            seen = _seen(case, entry, frame, invert=invert)
        except RefusedError as refusal:
            skipped.append(f"image of entry {entry.number} skipped: {refusal}")
        else:
            newest.setdefault(seen.observations.view, (entry, seen))
    if missing := [name for name in names if name not in newest]:
        since = f" after entry {after}" if after else ""
        why = f" ({'; '.join(skipped)})" if skipped else ""
        raise CaseError(
            f"the case holds no usable {' and no '.join(map(spoken, missing))} image{since}{why}; acquire it, or give "
            f"the files of {'both' if len(names) == len(NAMES) else 'all'} images"
        )
    source, seen = zip(*(newest[name] for name in names), strict=True)
    return SeenImages(seen, source, tuple(skipped))


def record_images(case: Case, taken: SeenImages, images: Images, frame: Frame, *, by: Actor) -> tuple[Entry, ...]:
    """Return the calibrated entries of the images, recorded unless the case holds the same result already.

    A file is acquired once. Raises UnusableInputError for beads without labels, which a case cannot replay; CaseError.
    """
    frame_ref = keep_frame(case, frame)
    sources = [_acquired(case, origin) if isinstance(origin, Path) else origin for origin in taken.source]
    return tuple(
        _recorded(case, source, image, frame_ref) or record_seen(case, source, image, frame_ref=frame_ref, by=by)
        for source, image in zip(sources, images, strict=True)
    )


def _acquired(case: Case, file: Path) -> Entry:
    if file.suffix.lower() == TABLE and are_detections(file):
        raise UnusableInputError("a case takes images or labelled beads; give the images, or a table with bead ids")
    data = read_bounded(file, MAX_FILE_BYTES, CaseError, "export single images")
    original = name_of(data, file.suffix.lower())
    held = case.latest(Kind.ACQUIRED, {"original": original})
    return record_acquired(case, data, file.suffix.lower(), by=Actor.COMMAND) if held is None else held


def _seen(case: Case, acquired: Entry, frame: Frame, *, invert: bool) -> ObservedView:
    image = image_of(case, acquired)
    image, beads = find_beads(image.inverted() if invert else image)
    view = None if frame.solid is None else view_of_acquired(case, acquired, image)
    return ObservedView(short(acquired.content["original"]), label_beads(image, beads, frame, view), image, beads)


def _recorded(case: Case, acquired: Entry, image: CalibratedImage, frame_ref: str) -> Entry | None:
    """Return the entry of the same view, calibrated from this image; None if there is none."""
    wanted = digest(canonical(contents.calibrated(image))), frame_ref
    calibrated = _made_from(case, acquired.number, Kind.CALIBRATED)
    return next((entry for entry in calibrated if (entry.content_sha256, entry.settings["frame"]) == wanted), None)
