"""From clicks in images to the holes of a nail and their plans: outlines along strokes, then both rims about a click in
each image."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sightline.calibration import CalibratedView
from sightline.calibration.bead_view import bead_shadows_px
from sightline.common.geometry.lines import nearest_approach, unit
from sightline.common.threads import one_blas_thread
from sightline.detection.metal_edges import MetalEdge, MetalTube, agreement, find_outline, find_rims
from sightline.errors import ReconstructionRefusedError, UnusableInputError
from sightline.imaging import Radiograph
from sightline.planning import Hole, HoleSeen, Nail, WirePicks, WirePlans, fit_hole, plan_wires
from sightline.planning.bone.directions import caudal, towards
from sightline.planning.nail.expected import (
    GRID_PX,
    LocalCamera,
    expected_rims,
    hole_candidates,
    metals_mm,
    patch_px,
)
from sightline.planning.nail.hole import farthest_apart, nail_line, turned_to_rims
from sightline.planning.nail.result import HolePose
from sightline.planning.procedures.document import ProcedureDocument
from sightline.planning.procedures.procedure import document_of

_HARDNESS = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.15)  # of beams of about 60 to 120 kV [ours]
_FIRST_BLUR_PX = 1.0  # for a first look at the rims
_BEAD_MARGIN_PX = 4.0  # from a bead's shadow to a usable point of a rim: half of its profile, and the blur [ours]
_MAX_SPACING_MM = 1.0  # of a nail's holes from the stated spacing: nails differ by 2 mm or more [ours]
# Points of each rim in each view: of 26 holes with four in images, nine were outside of their 95 % regions [rays of
# another projector].
_MIN_ARC_POINTS = 5
_MIN_AGREEMENT = 0.5  # [ours] correlation of the best candidate with the images: lower, most of it is another thing


@dataclass(frozen=True, eq=False)
class FoundNail:
    """A nail's outlines found in two images, and its axis: a point (3,) and a unit vector (3,), CFCS.

    `hardness`: of the beam, as for `detection.metal_edges.transmission`: that with which its outlines fit best.
    """

    views: tuple[CalibratedView, ...]
    images: tuple[Radiograph, ...]
    nail: Nail
    outlines: tuple[tuple[MetalEdge, MetalEdge], ...]
    hardness: float
    cameras: tuple[LocalCamera, ...]
    point_mm: np.ndarray
    along: np.ndarray


@one_blas_thread
def find_nail(
    views: Sequence[CalibratedView],
    images: Sequence[Radiograph],
    strokes_px: np.ndarray,
    nail: Nail | None = None,
) -> FoundNail:
    """Return a nail's outlines along strokes (2, 2, 2, 2): for each of two views, for each edge, two clicks (u, v).

    The strokes are at most a third of the nail's width from the edges, and both reach past the hole that is clicked
    next. Raises UnusableInputError, WireRefusedError, ReconstructionRefusedError, OutsideRegionError.
    """
    nail, strokes = nail or Nail(), np.asarray(strokes_px, dtype=np.float64)
    if len(views) != 2 or len(images) != 2 or strokes.shape != (2, 2, 2, 2) or not np.isfinite(strokes).all():
        raise UnusableInputError(
            "a nail is found in two views with their images and finite strokes of the shape (2, 2, 2, 2); got "
            f"{len(views)} views, {len(images)} images and {strokes.shape}"
        )
    lines = [view.lines_of_sight(own.mean(axis=(0, 1))[None]) for view, own in zip(views, strokes, strict=True)]
    farthest_apart(np.concatenate([seen.directions for seen in lines]))
    middle = nearest_approach(
        lines[0].focal_point_mm, lines[0].directions[0], lines[1].focal_point_mm, lines[1].directions[0]
    ).middle_mm
    cameras = tuple(LocalCamera.of(view, middle) for view in views)
    scales = [_px_per_mm(camera, middle) for camera in cameras]
    tried = {
        hardness: tuple(_outlines(*seen, nail, hardness) for seen in zip(images, strokes, scales, strict=True))
        for hardness in _HARDNESS
    }
    hardness = _best_fitting(tried)
    outlines = tried[hardness]
    focal = np.array([camera.focal_mm for camera in cameras])
    rays = [[camera.rays(edge.uv_px) for edge in both] for camera, both in zip(cameras, outlines, strict=True)]
    point, along = nail_line(focal, rays, middle)
    return FoundNail(tuple(views), tuple(images), nail, outlines, hardness, cameras, point, along)


@one_blas_thread
def find_hole(nail_seen: FoundNail, clicks_px: ArrayLike) -> Hole:
    """Return the hole of a nail near a click (u, v) in each view, (2, 2), a few pixels off.

    Raises UnusableInputError, ReconstructionRefusedError, OutsideRegionError, ErrorUnknownError.
    """
    clicks = np.asarray(clicks_px, dtype=np.float64)
    if clicks.shape != (2, 2) or not np.isfinite(clicks).all():
        raise UnusableInputError(f"give one finite click (u, v) in each of two views; got the shape {clicks.shape}")
    pose = _best(nail_seen, hole_candidates(nail_seen.cameras, nail_seen.point_mm, nail_seen.along, list(clicks)))
    near = turned_to_rims(nail_seen.cameras, _seen(nail_seen, pose, _FIRST_BLUR_PX), nail_seen.nail, pose)
    hole = fit_hole(nail_seen.views, _seen(nail_seen, near), nail_seen.nail, near)  # rims expected where they are
    if (fewest := hole.kept[:, 2:].min()) < _MIN_ARC_POINTS:
        raise ReconstructionRefusedError(
            f"a view shows only {fewest} points of a rim (at least {_MIN_ARC_POINTS} are needed): the lens is narrow, "
            "or other metal hides it, and its edge cannot be told from others; turn the C-arm until both views show "
            "the lens widely, and take metal away"
        )
    return hole


@one_blas_thread
def hole_edges(nail_seen: FoundNail, hole: Hole) -> list[HoleSeen]:
    """Return the edges of the nail and of both rims that each of the two images shows where `hole` has them."""
    return _seen(nail_seen, hole.pose)


def find_holes(nail_seen: FoundNail, distal_px: ArrayLike, proximal_px: ArrayLike, side: str) -> dict[str, Hole]:
    """Return both distal holes of a nail, "distal" and "proximal", each near a click in each view, (2, 2).

    `side`: of the patient, "right" or "left"; it tells which of the two is the distal one. Raises what `find_hole`
    raises, and ReconstructionRefusedError for one hole clicked twice, exchanged holes, and holes of another nail.
    """
    holes = {"distal": find_hole(nail_seen, distal_px), "proximal": find_hole(nail_seen, proximal_px)}
    refuse_confused(holes["distal"], holes["proximal"], nail_seen.nail, side)
    return holes


def refuse_confused(distal: Hole, proximal: Hole, nail: Nail, side: str) -> None:
    """Raise ReconstructionRefusedError for one hole taken twice, exchanged holes, and holes of another nail."""
    along = towards(distal.nail_direction, caudal(side), "the nail")
    apart = float((distal.middle_mm - proximal.middle_mm) @ along)
    if abs(apart) < nail.hole_mm:
        raise ReconstructionRefusedError(
            f"both holes are the same one: their axes are {abs(apart):.1f} mm apart along the nail; click another hole"
        )
    if apart < 0:
        raise ReconstructionRefusedError(
            f"the holes are exchanged: the one clicked as distal lies {-apart:.1f} mm proximal of the other; exchange "
            "the clicks, or correct the side"
        )
    if nail.spacing_mm is not None and abs(apart - nail.spacing_mm) > _MAX_SPACING_MM:
        raise ReconstructionRefusedError(
            f"the holes are {apart:.1f} mm apart in the images and {nail.spacing_mm:.1f} mm as stated: it is another "
            "nail or another hole; give the sizes of this nail, or click its holes again"
        )


@dataclass(frozen=True, eq=False)
class NailDrawn:
    """A nail in two images as a person gives it, to plan its holes.

    `nail`: as its maker states it. `strokes_px` (2, 2, 2, 2): as for `find_nail`. `clicks_px`: by the key of the
    procedure's wire a click (u, v) in each view, (2, 2), on the hole of that wire. `drilled`: keys of the holes that
    are drilled already; they are measured again, and the others are planned beside them.
    """

    nail: Nail
    strokes_px: np.ndarray
    clicks_px: Mapping[str, np.ndarray]
    drilled: tuple[str, ...] = ()

    @staticmethod
    def of(document: Mapping[str, Any]) -> "NailDrawn":
        """Return the nail of a JSON document with these fields."""
        clicks = {key: np.array(uv, dtype=np.float64) for key, uv in document["clicks_px"].items()}
        strokes = np.array(document["strokes_px"], dtype=np.float64)
        return NailDrawn(Nail(**document["nail"]), strokes, clicks, tuple(document["drilled"]))


def plan_holes(
    views: Sequence[CalibratedView],
    images: Sequence[Radiograph],
    drawn: NailDrawn,
    *,
    procedure: ProcedureDocument | str = "distal-interlocking",
    side: str | None = None,
    **shared: Any,
) -> WirePlans:
    """Return the plans of a nail's holes, found in the images of the first two views, and their relations.

    `images`: of the views. `procedure`: its wires are in their order from the nail's tip upwards. `side`, `shared`: as
    of `plan_wires`; the side tells which of two holes is the distal one. Raises UnusableInputError, WireRefusedError,
    and what `find_hole`, `find_holes` and `plan_wires` raise.
    """
    document = procedure if isinstance(procedure, ProcedureDocument) else document_of(procedure)
    keys = [wire.key for wire in document.wires if wire.key in drawn.clicks_px]
    if unknown := sorted({*drawn.clicks_px, *drawn.drilled} - set(keys)):
        raise UnusableInputError(
            f"{document.key} has no hole {unknown[0]!r} that was clicked; click in both images one or more of "
            f"{', '.join(wire.key for wire in document.wires)}"
        )
    _refuse_without_side(keys, side)
    nail_seen = find_nail(views[:2], images[:2], drawn.strokes_px, drawn.nail)
    holes = {key: find_hole(nail_seen, drawn.clicks_px[key]) for key in keys}
    return plan_found_holes(views, holes, procedure=document, drilled=drawn.drilled, side=side, **shared)


def plan_found_holes(
    views: Sequence[CalibratedView],
    holes: Mapping[str, Hole],
    *,
    procedure: ProcedureDocument,
    drilled: Sequence[str] = (),
    side: str | None = None,
    **shared: Any,
) -> WirePlans:
    """Return the plans of holes of one nail that `find_hole` found, by the procedure's wires in their order, and their
    relations.

    `drilled`: as of `NailDrawn`; the others as of `plan_holes`, which also names what is raised.
    """
    _refuse_without_side(holes, side)
    for (_, distal), (_, proximal) in pairwise(holes.items()):
        refuse_confused(distal, proximal, distal.nail, side or "")
    picks = {key: WirePicks.of_hole(hole, views) for key, hole in holes.items()}
    axes = {key: hole.axis for key in drilled if (hole := picks[key].hole) is not None}
    wanted = {key: wire for key, wire in picks.items() if key not in axes}
    return plan_wires(views, wanted, procedure=procedure, placed=axes, side=side, **shared)


def _refuse_without_side(holes: Collection[str], side: str | None) -> None:
    if side is None and len(holes) > 1:
        raise UnusableInputError("the side tells which hole is the distal one; give the side of the patient")


def _px_per_mm(camera: LocalCamera, at_mm: np.ndarray) -> float:
    aside = np.linalg.svd(unit(at_mm - camera.focal_mm)[None])[2][1]
    return float(np.linalg.norm(camera.project(at_mm + aside) - camera.project(at_mm)))


def _outlines(
    image: Radiograph, strokes: np.ndarray, px_per_mm: float, nail: Nail, hardness: float
) -> tuple[MetalEdge, MetalEdge]:
    diameter_px, bore_px = nail.diameter_mm * px_per_mm, nail.bore_mm * px_per_mm
    tube = MetalTube(diameter_px, bore_px, 1 / px_per_mm, nail.material, hardness)
    first, second = strokes
    return (
        find_outline(image, first, second.mean(axis=0), tube),
        find_outline(image, second, first.mean(axis=0), tube),
    )


def _best_fitting(tried: Mapping[float, tuple[tuple[MetalEdge, MetalEdge], ...]]) -> float:
    """Return the hardness with the smallest misfit of all outlines, each in units of its own smallest one."""
    misfits = np.array([[edge.misfit for both in outlines for edge in both] for outlines in tried.values()])
    return list(tried)[int((misfits / misfits.min(axis=0)).sum(axis=1).argmin())]


def _best(nail_seen: FoundNail, candidates: list[HolePose]) -> HolePose:
    """Return the candidate that looks most like the images. Raises ReconstructionRefusedError."""
    middle = candidates[len(candidates) // 2].hole_mm
    total = np.zeros(len(candidates))
    for camera, image in zip(nail_seen.cameras, nail_seen.images, strict=True):
        uv = patch_px(camera, middle, nail_seen.nail)
        metal = metals_mm(camera.focal_mm, camera.rays(uv), candidates, nail_seen.nail)
        total += agreement(image, uv, metal, nail_seen.nail.material, nail_seen.hardness) / len(nail_seen.images)
    if total.max() < _MIN_AGREEMENT:
        raise ReconstructionRefusedError(
            f"the images do not look like a hole near the clicks (correlation {total.max():.2f}, at least "
            f"{_MIN_AGREEMENT} is needed): the beams cross the hole too obliquely, or there is none; click the middle "
            "of the bright lens, or turn the C-arm towards the hole"
        )
    return candidates[int(total.argmax())]


def _seen(nail_seen: FoundNail, pose: HolePose, blur_px: float | None = None) -> list[HoleSeen]:
    """Return the edges that each image shows where a pose expects them; `blur_px` as in `find_rims`."""
    edges = []
    seen = zip(nail_seen.views, nail_seen.images, nail_seen.outlines, nail_seen.cameras, strict=True)
    for view, image, outlines, camera in seen:
        expected = expected_rims(camera, pose, nail_seen.nail)
        rims = find_rims(image, expected, GRID_PX, nail_seen.nail.material, nail_seen.hardness, blur_px)
        clear = ~_beside_bead(view, expected.uv_px)
        edges.append(HoleSeen(outlines, rims.edge(clear & ~expected.is_exit), rims.edge(clear & expected.is_exit)))
    return edges


def _beside_bead(view: CalibratedView, uv_px: np.ndarray) -> np.ndarray:
    """Return which pixels (N,) lie so near to the shadow of one of the frame's beads that it disturbs a rim there."""
    discs = bead_shadows_px(view)
    off = np.linalg.norm(uv_px[:, None] - discs[:, :2], axis=2) - discs[:, 2]
    return (off < _BEAD_MARGIN_PX).any(axis=1)
