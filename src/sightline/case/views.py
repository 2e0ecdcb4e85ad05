"""From two files to two calibrated views: images from a C-arm, or observations in CSV; a view as JSON."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import acos, cos, radians, sin
from pathlib import Path
from typing import Any

from sightline.calibration import BeadView, CArm
from sightline.calibration.maps.fit_map import Method
from sightline.case.journal.originals import anonymous_name
from sightline.detection import Detections, Observations
from sightline.detection.csv_files import are_detections, label_csv, read_observations
from sightline.errors import FrameError, ObservationsError, UnusableInputError
from sightline.frame import Frame
from sightline.from_images.pipeline import find_beads, known_arm, label_beads, view_of
from sightline.imaging import Radiograph, read_image
from sightline.planning.procedures import Procedure

NAMES = ("pa", "lateral")  # every pair of views is in this order
OBLIQUE = "oblique"  # a third image, after the pair
ALL_NAMES = (*NAMES, OBLIQUE)


class ImageSlot(str):
    """A place for an image of a case: its `view`, and its `purpose`, "" for the plan. As text, its name in files."""

    view: str
    purpose: str

    def __new__(cls, view: str, purpose: str = "") -> "ImageSlot":
        """Name the slot of a view."""
        slot = super().__new__(cls, f"{purpose}-{view}" if purpose else view)
        slot.view, slot.purpose = view, purpose
        return slot

    def __reduce__(self) -> "tuple[type[ImageSlot], tuple[str, str]]":
        """Return what a copy is made from."""
        return ImageSlot, (self.view, self.purpose)

    @staticmethod
    def read(name: str) -> "ImageSlot":
        """Return the slot of a name in a file."""
        purpose, _, view = name.rpartition("-")
        return ImageSlot(view, purpose)


CHECK_NAMES = (ImageSlot("pa", "check"), ImageSlot("lateral", "check"))
SHOT_NAMES = (ImageSlot("pa", "shot"), ImageSlot("lateral", "shot"))  # while drilling

# A beam this near to an axis of the patient is called by it; farther from both than _OBLIQUE_RAD it is oblique [ours].
# Between these a name might be wrong, and a person is asked.
_NEAR_RAD, _OBLIQUE_RAD = radians(25.0), radians(30.0)


def stated_view(image: Radiograph) -> str | None:
    """Return the view that the C-arm's angles in the image's file name; None where they are missing or between two.

    Plates tell their view; an image of a solid does not, so that this name or a person's is needed.
    """
    primary, secondary = image.tags.primary_angle_deg, image.tags.secondary_angle_deg
    if primary is None:
        return None
    to_left, tilt = radians(primary), cos(radians(secondary or 0.0))
    off = {"pa": acos(min(1.0, abs(tilt * cos(to_left)))), "lateral": acos(min(1.0, abs(tilt * sin(to_left))))}
    nearest = min(off, key=lambda name: off[name])
    if off[nearest] <= _NEAR_RAD:
        return nearest
    return OBLIQUE if off[nearest] >= _OBLIQUE_RAD else None


def spoken(view: str, kind: Procedure | None = None) -> str:
    """Return a view's name as people write it; of the pair of a procedure, its name there, for example "inlet"."""
    own = view if kind is None or view not in NAMES else kind.document.views[NAMES.index(view)].name
    return "PA" if own == "pa" else own


@dataclass(frozen=True, eq=False)
class ObservedView:
    """The labelled beads of one view before calibration.

    `source`: the short name that a case gives the file; never its own name, which may be a patient's. `image`: the
    image in which `beads` were found, inverted if the file shows the balls bright; both are None for a table of beads.
    """

    source: str
    observations: Observations
    image: Radiograph | None = None
    beads: Detections | None = None


@dataclass(frozen=True, eq=False)
class CalibratedImage:
    """One calibrated view, with the observations and the image that it was made from."""

    seen: ObservedView
    view: BeadView

    @property
    def name(self) -> str:
        """ "pa", "lateral" or "oblique"."""
        return self.view.name


def see(
    path: Path,
    frame: Frame,
    view: str | None = None,
    datums: dict[str, tuple[float, float]] | None = None,
    frame_index: int | None = None,
    *,
    invert: bool = False,
) -> ObservedView:
    """Find the beads of one image, label them (`label`) and refit hidden ones (`look_again`).

    Without `view`, the datum markers tell which view it is; a solid looks alike in all. An image that shows the balls
    bright is inverted, and a check says so; pass `invert`, as for `read_image`, if its bright balls are not found.
    Raises RefusedError, and what reading raises.
    """
    image, beads = find_beads(read_image(path, frame_index, invert=invert))
    return ObservedView(anonymous_name(path), label_beads(image, beads, frame, view, datums), image, beads)


def _from_csv(path: Path, name: str, frame: Frame) -> ObservedView:
    if are_detections(path):
        return ObservedView(anonymous_name(path), label_csv(path, frame))
    views = read_observations(path)
    if name in views:
        return ObservedView(anonymous_name(path), views[name])
    raise ObservationsError(f"{path.name} holds no observations of view {name!r}; it has: {', '.join(views)}")


def see_pair(pa: Path, lateral: Path, frame: Frame, *, invert: bool = False) -> tuple[ObservedView, ObservedView]:
    """Observe both views of a pair, each from an image or from observations in CSV (one file may hold both).

    `invert`: for both images, as for `read_image`. Raises UnusableInputError if the files are swapped or show the same
    view twice, and what reading raises.
    """
    pair = tuple(
        _from_csv(path, name, frame)
        if path.suffix.lower() == ".csv"
        else see(path, frame, None if frame.solid is None else name, invert=invert)
        for path, name in zip((pa, lateral), NAMES, strict=True)
    )
    names = tuple(seen.observations.view for seen in pair)
    if names == NAMES:
        return pair[0], pair[1]
    if names == NAMES[::-1]:
        raise UnusableInputError(
            f"PA and lateral are swapped: {pa.name} shows the lateral plates and {lateral.name} the PA plates; "
            "give the files in the other order, and check that each pick is written beside its own view"
        )
    wrong, path = (0, pa) if names[0] != NAMES[0] else (1, lateral)
    raise UnusableInputError(
        f"{path.name} was given as the {NAMES[wrong]} view, but shows the plates of view {names[wrong]!r}; "
        "give one PA and one lateral image of the same set-up"
    )


def takes_oblique(frame: Frame) -> bool:
    """Return True if the frame can be seen in a third image: plates are seen in the images of their own views only."""
    return frame.solid is not None or OBLIQUE in frame.views


def see_oblique(path: Path, frame: Frame, *, invert: bool = False) -> ObservedView:
    """Observe the third image of a set-up, or its observations in CSV.

    Raises FrameError for a frame with plates for two views, and what reading raises.
    """
    if not takes_oblique(frame):
        raise FrameError(
            f"a third image cannot be calibrated with frame {frame.name!r}, whose plates are for the views "
            f"{' and '.join(frame.views)} only; plan on two images, or use a block such as block60, which every image "
            "shows"
        )
    return (
        _from_csv(path, OBLIQUE, frame) if path.suffix.lower() == ".csv" else see(path, frame, OBLIQUE, invert=invert)
    )


def calibrated(
    seen: ObservedView,
    frame: Frame,
    method: Method = "smooth",
    c_arm: CArm | None = None,
    *,
    mirrored_display: bool | None = None,
) -> CalibratedImage:
    """Calibrate one view from its own beads, with the checks of its image; see `calibrate`."""
    view = view_of(seen.observations, seen.image, frame, method, c_arm, mirrored_display=mirrored_display)
    return CalibratedImage(seen, view)


def calibrate_pair(
    pair: Sequence[ObservedView], frame: Frame, method: Method, mirrored: Collection[str] = (), **known: float | None
) -> tuple[CalibratedImage, CalibratedImage]:
    """Calibrate both views as `calibrate_images` does."""
    first, second = calibrate_images(pair, frame, method, mirrored, **known)
    return first, second


def calibrate_images(
    seen: Sequence[ObservedView],
    frame: Frame,
    method: Method,
    mirrored: Collection[str] = (),
    *,
    source_detector_mm: float | None = None,
    pixel_mm: float | None = None,
) -> tuple[CalibratedImage, ...]:
    """Calibrate views, each from its own beads.

    `mirrored`: the views whose display a person saw to be mirrored. `source_detector_mm`, `pixel_mm`: of the C-arm; see
    `known_arm`. Raises UnusableInputError, and what `calibrate` raises.
    """
    names = [observed.observations.view for observed in seen]
    if unknown := sorted(set(mirrored) - set(names)):
        raise UnusableInputError(f"{unknown[0]!r} is not a view; name {' or '.join(names)} as mirrored")
    return tuple(
        calibrated(
            s,
            frame,
            method,
            known_arm(s.image, source_detector_mm, pixel_mm),
            mirrored_display=s.observations.view in mirrored or None,
        )
        for s in seen
    )


def view_document(image: CalibratedImage) -> dict[str, Any]:
    """Return a calibrated view as JSON types: geometry, the residual of each bead, checks."""
    view, seen = image.view, image.seen
    residuals = view.residuals
    return {
        "view": view.name,
        "source": seen.source,
        "method": view.method,
        "mirrored": view.mirrored,
        "coordinates": "CFCS",
        "focal_point_mm": view.focal_point_mm.tolist(),
        "residual_rms_mm": residuals.rms_mm,
        "leave_one_out_rms_mm": residuals.leave_one_out_rms_mm,
        "left_out": list(residuals.left_out),
        "beads": [
            {"id": i, "uv_px": uv.tolist(), "residual_mm": r.tolist(), "used": bool(used)}
            for i, uv, r, used in zip(
                residuals.ids, residuals.uv_px, residuals.residual_mm, residuals.used, strict=True
            )
        ],
        "checks": [vars(check) for check in view.checks],
    }
