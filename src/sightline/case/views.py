"""From two files to two calibrated views: images as a C-arm writes them, or observations in CSV."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from sightline.calibration import BeadView, CArm
from sightline.calibration.fit import Method
from sightline.case.journal.originals import called
from sightline.detection import Detections, Observations
from sightline.detection.detections_csv import are_detections, label_csv
from sightline.detection.files import read_observations
from sightline.errors import ObservationsError, UnusableInputError
from sightline.frame import Frame
from sightline.imaging import Radiograph, read_image
from sightline.pipeline import find_beads, known_arm, label_beads, view_of

NAMES = ("pa", "lateral")  # the order of a pair of views, everywhere


def spoken(view: str) -> str:
    """A view's name as people write it."""
    return "PA" if view == "pa" else view


@dataclass(frozen=True, eq=False)
class Seen:
    """One view before it is calibrated, and what was found in it. Without an image there are no `beads`.

    `image`: as its `beads` were found in it; inverted where the file shows the balls bright.
    `source`: the file as a case calls it, by its bytes; never its own name, which may be a patient's.
    """

    source: str
    observations: Observations
    image: Radiograph | None = None
    beads: Detections | None = None


@dataclass(frozen=True, eq=False)
class CalibratedImage:
    """One view with its geometry, and all it was made from."""

    seen: Seen
    view: BeadView

    @property
    def name(self) -> str:
        """ "pa" or "lateral"."""
        return self.view.name


def see(
    path: Path,
    frame: Frame,
    view: str | None = None,
    datums: dict[str, tuple[float, float]] | None = None,
    frame_index: int | None = None,
    *,
    invert: bool = False,
) -> Seen:
    """Beads of one image, found, labelled (`label`) and looked at again (`look_again`).

    Without `view`, the datum markers tell which it is. An image that shows the balls bright is inverted, and a check
    says so; `invert`, as of `read_image`, is for one whose bright balls are not found.
    """
    image, beads = find_beads(read_image(path, frame_index, invert=invert))
    return Seen(called(path), label_beads(image, beads, frame, view, datums), image, beads)


def _from_csv(path: Path, name: str, frame: Frame) -> Seen:
    if are_detections(path):
        return Seen(called(path), label_csv(path, frame))
    views = read_observations(path)
    if name in views:
        return Seen(called(path), views[name])
    raise ObservationsError(f"{path.name} holds no observations of view {name!r}; it has: {', '.join(views)}")


def see_pair(pa: Path, lateral: Path, frame: Frame, *, invert: bool = False) -> tuple[Seen, Seen]:
    """Both views of a pair, each from an image or from observations in CSV (one file may hold both). `invert`: of both
    images, as `read_image`.

    Raises UnusableInputError where the two are swapped or are one view twice, and whatever reading raises.
    """
    pair = tuple(
        _from_csv(path, name, frame) if path.suffix.lower() == ".csv" else see(path, frame, invert=invert)
        for path, name in zip((pa, lateral), NAMES, strict=True)
    )
    found = tuple(seen.observations.view for seen in pair)
    if found == NAMES:
        return pair[0], pair[1]
    if found == NAMES[::-1]:
        raise UnusableInputError(
            f"PA and lateral are swapped: {pa.name} shows the lateral plates and {lateral.name} the PA plates; "
            "give the files in the other order, and check that each pick is written beside its own view"
        )
    wrong, path = (0, pa) if found[0] != NAMES[0] else (1, lateral)
    raise UnusableInputError(
        f"{path.name} was given as the {NAMES[wrong]} view, but shows the plates of view {found[wrong]!r}; "
        "give one PA and one lateral image of the same set-up"
    )


def calibrated(
    seen: Seen,
    frame: Frame,
    method: Method = "smooth",
    c_arm: CArm | None = None,
    *,
    mirrored_display: bool | None = None,
) -> CalibratedImage:
    """One view, calibrated from its own beads, with the checks of its image; see `calibrate`."""
    view = view_of(seen.observations, seen.image, frame, method, c_arm, mirrored_display=mirrored_display)
    return CalibratedImage(seen, view)


def calibrate_pair(
    pair: Sequence[Seen],
    frame: Frame,
    method: Method,
    mirrored: Collection[str] = (),
    *,
    source_detector_mm: float | None = None,
    pixel_mm: float | None = None,
) -> tuple[CalibratedImage, CalibratedImage]:
    """Both views calibrated, each from its own beads.

    `mirrored`: the views whose display a person saw to be mirrored. `source_detector_mm`, `pixel_mm`: of the C-arm; see
    `known_arm`. Raises UnusableInputError, and what calibrating
    raises.
    """
    if unknown := sorted(set(mirrored) - set(NAMES)):
        raise UnusableInputError(f"there is no view {unknown[0]!r} whose display is mirrored; name pa or lateral")
    first, second = (
        calibrated(
            s,
            frame,
            method,
            known_arm(s.image, source_detector_mm, pixel_mm),
            mirrored_display=s.observations.view in mirrored or None,
        )
        for s in pair
    )
    return first, second
