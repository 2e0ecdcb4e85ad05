"""From images to results in one call: a calibrated view, a check shot of two images; and the order of drilling.

Wires in the bone hide beads of the next check images; the proposed order hides few.
"""

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise, permutations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sightline.calibration import BeadView, CArm, calibrate
from sightline.calibration.maps.fit_map import Method
from sightline.calibration.view import CalibratedView
from sightline.common.threads import one_blas_thread
from sightline.detection import Detections, Observations, detect, is_inverted, label, look_again
from sightline.detection.causes import cause_of
from sightline.detection.common_shape import shape_checks
from sightline.detection.wire import ProjectedWire, WireShadow, find_wire
from sightline.errors import DetectionRefusedError, LabellingRefusedError, OutsideRegionError, WireRefusedError
from sightline.frame import Frame
from sightline.frame.designs import BUILTIN, SOLIDS
from sightline.frame.plate import Fiducial
from sightline.imaging import GeometryTags, Radiograph, as_radiograph, image_checks
from sightline.planning import Plan, reconstruct
from sightline.planning.bone.registered import RegisteredBone
from sightline.planning.check.result import CheckShot
from sightline.planning.check.shot import Landmarks
from sightline.planning.check.shot import check_shot as adjusted
from sightline.planning.check.wires import (
    BEFORE_MM,
    GUIDED_MM,
    STILL,
    Beforehand,
    ExpectedWire,
    PlacedWire,
    by_bone,
    expected_wire,
    nail_px,
    placed_wires,
)
from sightline.planning.procedures.document import ProcedureDocument
from sightline.planning.verdict.relations import WireLines

# Of placed wires [ours]: a line within the first must be another that was clicked, since parallel screws are up to 25
# mm apart; a wire may be clicked as far beside its line as the second, less than half of the distance to the next.
_PLACED_CORRIDOR_MM, _CLICKED_MM = 25.0, 4.0
_SQUARE = 1e-3  # [ours] share by which a pixel's sides may differ: makers round them to three or four digits
DATUM_BEADS = 5.0  # a datum counts as so many beads: without it an image may not be labelled [ours]
_OUTSIDE_MM = 100.0  # [ours] of a wire of 200 mm outside the entry, which hides beads too
_STEP_MM = 0.5
MIN_BLOCK, MAX_BLOCK = 9, 40  # balls of a block, some of them hidden, or with false ones [ours]; plates show 60 or more


@one_blas_thread
def calibrate_image(
    image: Radiograph | np.ndarray | str | Path,
    frame: Frame | str | Path,
    view: str | None = None,
    method: Method = "smooth",
    *,
    white: float | None = None,
    datums: Mapping[str, tuple[float, float]] | None = None,
    mirrored_display: bool | None = None,
    c_arm: CArm | None = None,
) -> BeadView:
    """Return the calibrated view of one image: `detect`, `label`, `look_again` and `calibrate` in one step.

    `image`, `white`: as of `detect`; an image that shows the balls bright is inverted, and a check says so. `frame`: a
    Frame, a frame file or the name of a built-in frame. `view`: what the image must show; without it the datum markers
    tell. `datums`: as of `label`. `mirrored_display`, `c_arm`: as of `calibrate`; without `c_arm` the distances that
    the image's file states are used.
    Raises ImageError, DetectionRefusedError, LabellingRefusedError, FrameError, UnusableInputError,
    CalibrationRefusedError.

    >>> view = sl.calibrate_image("out/demo/demo_pa.dcm", "gamma")
    """
    frame = Frame.of(frame)
    image, beads = find_beads(as_radiograph(image, white))
    observations = label_beads(image, beads, frame, view, datums)
    return view_of(observations, image, frame, method, c_arm or known_arm(image), mirrored_display=mirrored_display)


@one_blas_thread
def check_shot(
    plan: Plan,
    planned: Sequence[CalibratedView],
    images: Sequence[Radiograph | np.ndarray | str | Path],
    frame: Frame | str | Path,
    *,
    landmarks: Landmarks | None = None,
    bone: RegisteredBone | None = None,
    others_mm: Sequence[np.ndarray] = (),
    white: float | None = None,
) -> CheckShot:
    """Return where two more images show the inserted wire, against its plan.

    `planned`: the views of the plan; `images`: of the first two of them, in their order, with the wire in the bone;
    `frame`, `white`: as of `calibrate_image`. `landmarks`: three points of the bone picked in all four images, which
    tell how the bone moved since. `bone`: of the plan's CT or mesh, registered in these images, which tells it without
    landmarks. `others_mm`: entry and end (2, 3), planned or measured, of each other wire that may
    be in the images, such as `WirePlans.others_mm(key)`.
    Raises what `calibrate_image` raises, WireRefusedError, UnusableInputError, ReconstructionRefusedError,
    OutsideRegionError, ErrorUnknownError.

    >>> pa, lateral = sl.load("out/demo/views.json")
    >>> plan = sl.plan([pa, lateral], [[162, 689], [684, 692]], [[818, 366], [378, 276]], side="right")
    >>> shot = sl.check_shot(plan, [pa, lateral], ["check_pa.dcm", "check_lateral.dcm"], "gamma")
    >>> shot.passed  # without landmarks nothing tells whether the bone moved
    False
    """
    frame = Frame.of(frame)
    views, shown = [], []
    for before, given in zip(planned[:2], images, strict=True):
        image, beads = find_beads(as_radiograph(given, white))
        observations = label_beads(image, beads, frame, before.name)
        views.append(view_of(observations, image, frame, c_arm=known_arm(image)))
        shown.append((image, beads, views[-1]))
    known = known_by(plan, bone, views)
    wires = [
        find_planned_wire(plan, image, beads, view, plan.kind.wire_mm, others_mm, known=known)
        for image, beads, view in shown
    ]
    return adjusted(plan.to_check(planned), views, wires, landmarks=landmarks, known=known)


def known_by(plan: Plan, bone: RegisteredBone | None, checked: Sequence[CalibratedView]) -> Beforehand:
    """Return what a bone that is registered in the images of the views `checked` tells of its movement since the plan.

    Raises what `by_bone` raises.
    """
    if bone is None:
        return STILL
    return by_bone(plan.arguments["bone"], bone, plan.trajectory.points.xyz_mm, checked)


def find_planned_wire(  # noqa: PLR0917
    plan: Plan,
    image: Radiograph,
    beads: Detections,
    view: CalibratedView,
    wire_mm: float,
    others_mm: Sequence[np.ndarray] = (),
    *,
    known: Beforehand = STILL,
) -> WireShadow:
    """Return the wire of diameter `wire_mm` in a check image, searched for about its plan.

    A drill through the hole of a nail is searched for outside the nail, farther out, where its sleeve keeps it
    straight. `others_mm`: as of `check_shot`; `known`: of the bone's movement since the plan. Raises what
    `expected_wire` and `find_wire` raise.
    """
    search = planned_search(plan, view, others_mm, known)
    return find_wire(image, search.expected, wire_mm, beads, others=search.others, covered_px=search.covered_px)


class WireSearch(NamedTuple):
    """Where `find_wire` searches for a planned wire: its arguments of these names."""

    expected: ProjectedWire
    others: Sequence[ProjectedWire]
    covered_px: Sequence[np.ndarray]


def planned_search(
    plan: Plan, view: CalibratedView, others_mm: Sequence[np.ndarray] = (), known: Beforehand = STILL
) -> WireSearch:
    """Return where `find_planned_wire` searches."""
    ends_mm, movement = plan.trajectory.points.xyz_mm, known.movement
    if known is not STILL:  # a motion that is none may change the last bit
        ends_mm, others_mm = movement.apply(ends_mm), [movement.apply(line) for line in others_mm]
    before_mm, covered = (BEFORE_MM, ()) if plan.hole is None else (GUIDED_MM, [nail_px(view, plan.hole, movement)])
    expected = expected_wire(view, ends_mm, plan.kind.limits.beyond_mm, before_mm)
    return WireSearch(expected, expected_wires(others_mm, view), covered)


def find_placed_wires(
    seen: Sequence[tuple[Radiograph, Detections, CalibratedView]],
    clicked_uv_px: Mapping[str, np.ndarray],
    wire_mm: Mapping[str, float],
) -> dict[str, PlacedWire]:
    """Return wires that are in the bone already, from entry to tip, by key; each is found in two planning images.

    `seen`: image, beads and view of the plan, of which the first two count. `clicked_uv_px`: entry and tip (2, 2) of
    each wire in each view, (2, 2, 2), IDCS; a few millimetres beside it are enough. `wire_mm`: diameters. Click every
    wire that the images show: another line beside one of them is refused. Raises WireRefusedError, and what
    `placed_wires` raises.
    """
    both, keys = seen[:2], list(clicked_uv_px)
    views = [view for _, _, view in both]
    clicked = np.concatenate([np.asarray(clicked_uv_px[key], dtype=np.float64) for key in keys], axis=1)
    ends = dict(zip(keys, reconstruct(views, clicked).xyz_mm.reshape(-1, 2, 3), strict=True))
    wires = {key: [_placed(key, ends, shown, wire_mm[key]) for shown in both] for key in keys}
    return placed_wires(views, wires, {key: shown[0] for key, shown in ends.items()})


def _placed(
    key: str, ends_mm: Mapping[str, np.ndarray], seen: tuple[Radiograph, Detections, CalibratedView], wire_mm: float
) -> WireShadow:
    """Return the wire near one of these lines in an image; the other lines are wires too. Raises WireRefusedError."""
    image, beads, view = seen
    expected = expected_wire(view, ends_mm[key])
    others = expected_wires([ends for name, ends in ends_mm.items() if name != key], view)
    try:
        shadow = find_wire(image, expected, wire_mm, beads, others=others, corridor_mm=_PLACED_CORRIDOR_MM)
    except WireRefusedError as refused:
        raise WireRefusedError(f"placed wire {key!r}, view {view.name!r}: {refused}") from None
    off_px = np.linalg.norm(shadow.uv_px[:, None] - expected.uv_px, axis=-1).min(axis=1)
    off_mm = float(np.median(off_px) / np.median(expected.px_per_mm))
    if off_mm > _CLICKED_MM:
        raise WireRefusedError(
            f"placed wire {key!r}, view {view.name!r}: the line found lies {off_mm:.1f} mm beside the clicks (at most "
            f"{_CLICKED_MM:.0f} mm); click entry and tip of the wire, and check that both images show it"
        )
    return shadow


def expected_wires(lines_mm: Sequence[np.ndarray], view: CalibratedView) -> list[ExpectedWire]:
    """Return wires from entry to end (2, 3) as a view shows them, without those outside its field."""
    expected = []
    for ends in lines_mm:
        with suppress(OutsideRegionError):
            expected.append(expected_wire(view, ends))
    return expected


def find_beads(image: Radiograph) -> tuple[Radiograph, Detections]:
    """Return the image and its beads; the image is inverted where it shows the balls bright.

    Raises what `detect` raises.
    """
    beads = detect(image)
    if is_inverted(beads):
        with suppress(DetectionRefusedError):
            other = image.inverted()
            dark = detect(other)
            if not is_inverted(dark):
                return other, dark
    return image, beads


def label_beads(
    image: Radiograph,
    beads: Detections,
    frame: Frame,
    view: str | None = None,
    datums: Mapping[str, tuple[float, float]] | None = None,
    *,
    live: bool = False,
) -> Observations:
    """Return the labelled beads of an image (`label`), partly hidden ones fitted again (`look_again`).

    Raises LabellingRefusedError, which names what is wrong with the image where its pixels tell, and which other
    frame's balls it shows. The latter takes up to a second, so a `live` image is refused without it.
    """
    try:
        observations = label(beads, frame, view, datums)
    except LabellingRefusedError as refused:
        why = cause_of(image, np.column_stack([beads.uv_px, beads.radius_px]), beads.rejected)
        other = "" if live else _of_another_frame(beads, frame)
        raise LabellingRefusedError(other + (f"{why} ({refused})" if why else str(refused))) from None
    return look_again(image, beads, observations, frame)


def _of_another_frame(beads: Detections, frame: Frame) -> str:
    """Return a sentence on the built-in frame that the beads are of; empty where none is known."""
    for known in (frame, *map(Frame.load, BUILTIN)):
        with suppress(LabellingRefusedError):
            label(beads, known)
            if known.name == frame.name:  # the view that was stated is wrong, or the datums
                return ""
            shown = f"the image shows the frame {known.name}, not {frame.name}"
            return f"{shown}: give --frame {known.name}. With {frame.name}: "
    if frame.solid is None and MIN_BLOCK <= len(beads) <= MAX_BLOCK:
        return (
            f"{len(beads)} balls are seen, as many as a block has, and {frame.name} has two plates in each view: if a "
            f"block is in the image, give its file, or --frame {' or '.join(SOLIDS)}. With {frame.name}: "
        )
    return ""


def known_arm(
    image: Radiograph | None, source_detector_mm: float | None = None, pixel_mm: float | None = None
) -> CArm | None:
    """Return what is known of an image's C-arm: as given, else as the file states it; None without a distance."""
    tags = GeometryTags() if image is None else image.tags
    distance = source_detector_mm or tags.source_detector_mm
    if pixel_mm is None and tags.imager_pixel_spacing_mm is not None:
        along, across = tags.imager_pixel_spacing_mm
        pixel_mm = along if abs(along - across) <= _SQUARE * along else None
    return None if distance is None else CArm(distance, pixel_mm)


def view_of(
    observations: Observations,
    image: Radiograph | None,
    frame: Frame,
    method: Method = "smooth",
    c_arm: CArm | None = None,
    *,
    mirrored_display: bool | None = None,
) -> BeadView:
    """Return the view that labelled beads determine, with the checks of their image where there is one.

    Raises what `calibrate` raises.
    """
    view = calibrate(observations, frame, method=method, c_arm=c_arm)
    if image is not None:
        view = view.checked((*image_checks(image), *shape_checks(image, observations.uv_px, observations.radius_px)))
    return view.said_to_be(mirrored_display)


@dataclass(frozen=True, eq=False)
class DrillingOrder:
    """An order of drilling, by the wires' keys.

    `hidden`: for each wire, how many beads the wires that are in the bone before it hide in its check images; a datum
    counts as DATUM_BEADS.
    """

    keys: tuple[str, ...]
    hidden: tuple[float, ...]

    def sentence(self, names: Mapping[str, str]) -> str:
        """Return the order and what it hides, with the wires' names by key."""
        order = ", then the ".join(names[key] for key in self.keys)
        counts = ", ".join(f"{count:.0f}" for count in self.hidden)
        return (
            f"Drill the {order}. At the checks of these wires, those in the bone before hide {counts} beads in the "
            f"plan's views; a datum counts as {DATUM_BEADS:.0f}."
        )


def propose_order(
    wires: WireLines,
    procedure: ProcedureDocument,
    views: Sequence[CalibratedView],
    frame: Frame,
    placed: Collection[str] = (),
) -> DrillingOrder:
    """Return the order of drilling in which the wires in the bone hide the fewest beads, summed over all checks.

    `wires`: to be drilled or, by their keys in `placed`, in the bone already. `views`: the check images are expected
    from the same directions. The order keeps to the relations "order" of `procedure`; of orders that hide the same
    number the first in the file's own order is taken.
    """
    diameters = {wire.key: wire.diameter_mm for wire in procedure.wires}
    hides = {
        key: np.concatenate([_hidden(ends, diameters[key], view, frame) for view in views])
        for key, ends in zip(wires.keys, wires.ends_mm, strict=True)
    }
    weights = np.concatenate([[DATUM_BEADS if bead.datum else 1.0 for bead in _beads(frame, view)] for view in views])

    def hidden(order: Sequence[str]) -> tuple[float, ...]:
        before = np.any([np.zeros(len(weights), dtype=bool), *(hides[key] for key in placed)], axis=0)
        counts = []
        for key in order:
            counts.append(float(weights @ before))
            before = before | hides[key]
        return tuple(counts)

    chains = [relation.wires for relation in procedure.relations if relation.relation == "order"]
    free = [key for key in procedure.drilling_order if key in wires.keys and key not in placed]
    orders = [order for order in permutations(free) if all(_kept(chain, order) for chain in chains)]
    best = min(orders or [tuple(free)], key=lambda order: sum(hidden(order)))
    return DrillingOrder(best, hidden(best))


def _kept(chain: Sequence[str], order: Sequence[str]) -> bool:
    places = [order.index(key) for key in chain if key in order]
    return all(a < b for a, b in pairwise(places))


def _beads(frame: Frame, view: CalibratedView) -> tuple[Fiducial, ...]:
    return frame.fiducials_of(view.name) if frame.solid is None else frame.solid.fiducials


def _hidden(ends_mm: np.ndarray, diameter_mm: float, view: CalibratedView, frame: Frame) -> np.ndarray:
    """Return which beads (N,) bool of a view a wire overlies, wholly or in part, where the view shows them."""
    beads, focal = _beads(frame, view), view.focal_point_mm
    xyz, radius = np.array([bead.xyz_mm for bead in beads]), np.array([bead.diameter_mm / 2 for bead in beads])
    entry, end = ends_mm
    length = float(np.linalg.norm(end - entry))
    on = entry + np.arange(-_OUTSIDE_MM, length, _STEP_MM)[:, None] * (end - entry) / length - focal
    rays = xyz - focal
    reach = np.linalg.norm(rays, axis=1)
    off = np.linalg.norm(np.cross(on[:, None], rays / reach[:, None]), axis=-1)
    shadow = radius * np.linalg.norm(on, axis=1)[:, None] / reach  # the bead's radius at the depth of the wire
    return (off < shadow + diameter_mm / 2).any(axis=0) & view.project_seen(xyz)[1]
