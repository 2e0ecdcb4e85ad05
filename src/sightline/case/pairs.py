"""The pair of PA and lateral images that a case works on: given files, or the newest images of the case."""

from dataclasses import dataclass
from pathlib import Path

from sightline.bounded import read_bounded
from sightline.case import contents
from sightline.case.canonical import canonical, digest
from sightline.case.contents import Pair
from sightline.case.journal import Actor, Case, Entry, Kind
from sightline.case.journal.originals import name_of, short
from sightline.case.stages import TABLE, acquired_of, image_of, keep_frame, record_acquired, record_seen
from sightline.case.views import NAMES, CalibratedImage, ObservedView, see_pair, spoken
from sightline.detection.detections_csv import are_detections
from sightline.errors import CaseError, RefusedError, UnusableInputError
from sightline.frame import Frame
from sightline.imaging.limits import MAX_FILE_BYTES
from sightline.pipeline import find_beads, label_beads


@dataclass(frozen=True, eq=False)
class SeenPair:
    """PA and lateral image before calibration, and their `source`: files, or the entries that acquired them.

    `skipped`: newer images of the case that were not used, each with the reason.
    """

    seen: tuple[ObservedView, ObservedView]
    source: tuple[Path, Path] | tuple[Entry, Entry]
    skipped: tuple[str, ...] = ()


def given_pair(files: tuple[Path, Path], frame: Frame, *, invert: bool = False) -> SeenPair:
    """Return the images, or tables of beads, of two files, PA first. Raises what `see_pair` raises."""
    return SeenPair(see_pair(*files, frame, invert=invert), files)


def newest_pair(case: Case, frame: Frame, *, after: int = 0, invert: bool = False) -> SeenPair:
    """Return the newest PA and the newest lateral image among the entries after number `after`.

    An image whose beads cannot be found or labelled is skipped. `invert`: the balls are bright. Raises CaseError if a
    view has no image.
    """
    found: dict[str, tuple[Entry, ObservedView]] = {}
    skipped: list[str] = []
    for entry in reversed(case.entries(Kind.ACQUIRED, after)):
        if entry.content["original"].endswith(TABLE) or len(found) == len(NAMES):
            continue
        try:
            seen = _seen(case, entry, frame, invert=invert)
        except RefusedError as refusal:
            skipped.append(f"image of entry {entry.number} skipped: {refusal}")
        else:
            found.setdefault(seen.observations.view, (entry, seen))
    if missing := [name for name in NAMES if name not in found]:
        since = f" after entry {after}" if after else ""
        why = f" ({'; '.join(skipped)})" if skipped else ""
        raise CaseError(
            f"the case holds no usable {' and no '.join(map(spoken, missing))} image{since}{why}; acquire it, or give "
            "the files of both images"
        )
    (first, pa), (second, lateral) = (found[name] for name in NAMES)
    return SeenPair((pa, lateral), (first, second), tuple(skipped))


def record_pair(case: Case, pair: SeenPair, images: Pair, frame: Frame, *, by: Actor) -> tuple[Entry, Entry]:
    """Return the calibrated entries of both images, recorded unless the case holds the same result already.

    A file is acquired once. Raises UnusableInputError for beads without labels, which a case cannot replay; CaseError.
    """
    frame_ref = keep_frame(case, frame)
    sources = [_acquired(case, one) if isinstance(one, Path) else one for one in pair.source]
    first, second = (
        _recorded(case, source, image, frame_ref) or record_seen(case, source, image, frame_ref=frame_ref, by=by)
        for source, image in zip(sources, images, strict=True)
    )
    return first, second


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
    return ObservedView(short(acquired.content["original"]), label_beads(image, beads, frame), image, beads)


def _recorded(case: Case, acquired: Entry, image: CalibratedImage, frame_ref: str) -> Entry | None:
    """Return the entry of the same view, calibrated from this image; None if there is none."""
    sha256 = digest(canonical(contents.calibrated(image)))
    for entry in reversed(case.entries(Kind.CALIBRATED, acquired.number)):
        same = entry.content_sha256 == sha256 and entry.settings["frame"] == frame_ref
        if same and acquired_of(case, entry).number == acquired.number:
            return entry
    return None
