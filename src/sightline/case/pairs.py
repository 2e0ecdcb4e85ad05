"""The images that a plan or check shot is made on, PA and lateral, for a plan also a third: given files, or the newest
images of a case."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sightline.case import contents
from sightline.case.canonical import canonical, digest
from sightline.case.contents import Images
from sightline.case.journal import Actor, Case, Entry, Kind
from sightline.case.journal.originals import name_of, short
from sightline.case.stages import (
    TABLE,
    acquired_of,
    image_of,
    keep_frame,
    record_acquired,
    record_seen,
    view_of_acquired,
)
from sightline.case.views import NAMES, CalibratedImage, ObservedView, see_oblique, see_pair, spoken
from sightline.common.bounded import read_bounded
from sightline.detection.csv_files import are_detections
from sightline.errors import CaseError, RefusedError, UnusableInputError
from sightline.frame import Frame
from sightline.from_images.pipeline import find_beads, label_beads
from sightline.imaging.formats import MAX_FILE_BYTES


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
    found: dict[str, tuple[Entry, ObservedView]] = {}
    skipped: list[str] = []
    for entry in reversed(case.entries(Kind.ACQUIRED, after)):
        if entry.content["original"].endswith(TABLE) or found.keys() >= set(names):
            continue
        try:
            seen = _seen(case, entry, frame, invert=invert)
        except RefusedError as refusal:
            skipped.append(f"image of entry {entry.number} skipped: {refusal}")
        else:
            found.setdefault(seen.observations.view, (entry, seen))
    if missing := [name for name in names if name not in found]:
        since = f" after entry {after}" if after else ""
        why = f" ({'; '.join(skipped)})" if skipped else ""
        raise CaseError(
            f"the case holds no usable {' and no '.join(map(spoken, missing))} image{since}{why}; acquire it, or give "
            f"the files of {'both' if len(names) == len(NAMES) else 'all'} images"
        )
    source, seen = zip(*(found[name] for name in names), strict=True)
    return SeenImages(seen, source, tuple(skipped))


def record_images(case: Case, taken: SeenImages, images: Images, frame: Frame, *, by: Actor) -> tuple[Entry, ...]:
    """Return the calibrated entries of the images, recorded unless the case holds the same result already.

    A file is acquired once. Raises UnusableInputError for beads without labels, which a case cannot replay; CaseError.
    """
    frame_ref = keep_frame(case, frame)
    sources = [_acquired(case, one) if isinstance(one, Path) else one for one in taken.source]
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
    sha256 = digest(canonical(contents.calibrated(image)))
    for entry in reversed(case.entries(Kind.CALIBRATED, acquired.number)):
        same = entry.content_sha256 == sha256 and entry.settings["frame"] == frame_ref
        if same and acquired_of(case, entry).number == acquired.number:
            return entry
    return None
