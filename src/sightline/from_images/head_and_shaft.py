"""Fits the drawn circles of a femoral head and the drawn borders of a shaft to the edges that the images show.

The shaft's axis lies midway between its edges. Both begin equally far outside of where the image falls most steeply, so
this distance cancels in the axis.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from sightline.calibration.view import CalibratedView, LinesOfSight
from sightline.common.geometry.lines import nearest_approach, unit
from sightline.detection.bone_edges import (
    REACH_PX,
    UNEVEN,
    BoneEdge,
    NoBoneEdgeError,
    common_begin,
    find_bone_edge,
    points_of_border,
)
from sightline.errors import OutsideRegionError, ReconstructionRefusedError, UnusableInputError
from sightline.imaging import Radiograph
from sightline.planning.bone.aids import Aids, Circle, Line
from sightline.planning.bone.anatomy import locate
from sightline.planning.bone.drawings import MAX_UNEQUAL, Axis
from sightline.planning.bone.head import find_head

MIN_RADIUS_PX = 4 * REACH_PX  # of a circle, far from its other side; and length of a neck's border
_MIN_LENGTH_PX = 8 * REACH_PX  # so that most of a border lies beside its edge, however it is tilted
_MAX_TAPER_DEG = 2.0  # of both borders; 0.75° are of the projection [calc], the rest is the bone's [ours]
_Drawn = TypeVar("_Drawn", Circle, Line)


def fit_head(
    views: Sequence[CalibratedView], images: Sequence[Radiograph], drawn: tuple[Circle, Circle]
) -> tuple[tuple[Circle, Circle], dict[str, str]]:
    """Return the head's circles fitted to the edges that the images show within 12 px of them, and what was kept.

    Its covariances are those of the fits. A circle is kept where its image shows no clear edge, or two, and both where
    they are not of one sphere: the reason stands at the view's name. `views`, `images`: PA and lateral first.
    """
    head, kept = fitted_or_kept(views, images, drawn, lambda view, image, circle: _circle(image, circle))
    if len(kept) < 2 and (why := _no_sphere(views, head)):
        return drawn, dict.fromkeys([view.name for view in views[:2]], why)
    return head, kept


def fitted_or_kept(
    views: Sequence[CalibratedView],
    images: Sequence[Radiograph],
    drawn: tuple[_Drawn, _Drawn],
    fit: Callable[[CalibratedView, Radiograph, _Drawn], _Drawn],
) -> tuple[tuple[_Drawn, _Drawn], dict[str, str]]:
    """Return what `fit` makes of the drawings in both images. A drawing is kept where `fit` raises NoBoneEdgeError or
    OutsideRegionError: the reason stands at the view's name."""
    fitted, kept = list(drawn), {}
    for k, (view, image) in enumerate(zip(views[:2], images[:2], strict=True)):
        try:
            fitted[k] = fit(view, image, drawn[k])
        except (NoBoneEdgeError, OutsideRegionError) as why:
            kept[view.name] = str(why)
    return (fitted[0], fitted[1]), kept


def _no_sphere(views: Sequence[CalibratedView], head: tuple[Circle, Circle]) -> str:
    """Return why outlines are not those of one sphere; "" where they are."""
    try:
        agreement = find_head(views, head)[2]
    except (ReconstructionRefusedError, OutsideRegionError) as why:
        return str(why)
    return "" if agreement is None or agreement.passed else "the edges near both drawings are not those of one sphere"


def _circle(image: Radiograph, drawn: Circle) -> Circle:
    """Return points of the rim on its edge. They need not lie on a circle: the head is fitted to them in space."""
    by_circle = np.column_stack([2 * drawn.uv_px, np.ones(len(drawn.uv_px))])
    u, v, rest = np.linalg.lstsq(by_circle, (drawn.uv_px**2).sum(axis=1), rcond=None)[0]
    radius = float(np.sqrt(rest + u * u + v * v))
    if radius < MIN_RADIUS_PX:
        raise NoBoneEdgeError(f"its radius is {radius:.0f} px (at least {MIN_RADIUS_PX:.0f} px are needed)")
    turns = 2 * np.pi * np.arange(int(2 * np.pi * radius)) / int(2 * np.pi * radius)
    outward = np.column_stack([np.cos(turns), np.sin(turns)])
    oval = np.column_stack([np.cos(2 * turns), np.sin(2 * turns)])  # as the image of a sphere may be
    uv = [u, v] + radius * outward
    edge = find_bone_edge(image, uv, -outward, np.column_stack([np.ones(len(turns)), outward]), oval)
    own = outward[edge.at]
    uneven = (UNEVEN * radius) ** 2 * own @ own.T
    at, covariance = _moved(uv[edge.at], -own, edge.offset_px, edge.covariance_px2 + uneven)
    # Three numbers of it measure the sphere: what else the edge shows, such as its flatness, is the bone's own.
    return Circle(at, covariance, np.linalg.pinv(np.column_stack([own, np.ones(len(at))])))


def _moved(
    uv_px: np.ndarray, inward: np.ndarray, offset_px: np.ndarray, covariance_px2: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return points (K, 2) moved inwards by offsets (K,), and the covariance (2K, 2K) of theirs across the edge.

    Along the edge their place is chosen, not measured: it has no error.
    """
    across = np.einsum("ij,ik->ikj", np.eye(len(uv_px)), inward).reshape(2 * len(uv_px), len(uv_px))
    return uv_px + offset_px[:, None] * inward, across @ covariance_px2 @ across.T


def refuse_tables(images: Sequence[Radiograph | None]) -> list[Radiograph]:
    """Return the images. Raises UnusableInputError where a view has none."""
    shown = [image for image in images if image is not None]
    if len(shown) < len(images):
        raise UnusableInputError("head and shaft are fitted to edges of images; a table of beads shows no edge")
    return shown


def fit_shaft(
    views: Sequence[CalibratedView], images: Sequence[Radiograph], drawn: tuple[Line, Line]
) -> tuple[tuple[Line, Line], dict[str, str]]:
    """Return a shaft's axis between the edges that the images show within 12 px of its borders, and what was kept.

    Its covariances are those of the fits; they have no part along the axis. A line is kept where it was drawn without
    borders, where its image shows no clear edge beside one of them, or two, and where its edges are not straight and
    parallel; both where they are not of one shaft. The reason stands at the view's name. `views`, `images`: PA and
    lateral first.
    """
    lines, kept = fitted_or_kept(views, images, drawn, _axis)
    if not kept and (why := _no_shaft(views, lines)):
        return drawn, dict.fromkeys([view.name for view in views[:2]], why)
    return lines, kept


@dataclass(frozen=True, eq=False)
class _Border:
    """A border's edge: its points (K, 2), px, and `inward` (2,) of the drawn line."""

    uv_px: np.ndarray
    inward: np.ndarray
    edge: BoneEdge

    @staticmethod
    def found(image: Radiograph, ends: np.ndarray, other: np.ndarray) -> "_Border":
        """Return the edge near a border drawn from end to end (2, 2), the `other` border beside it.

        Raises NoBoneEdgeError.
        """
        uv, inward, along = points_of_border(ends, other, _MIN_LENGTH_PX)
        straight, bent = np.column_stack([np.ones(len(along)), along]), along[:, None] ** 2 - 1 / 3
        edge = find_bone_edge(image, uv, np.broadcast_to(inward, uv.shape), straight, bent)
        return _Border(uv[edge.at] + edge.offset_px[:, None] * inward, inward, edge)

    def covariance_px2(self, half_px: float) -> np.ndarray:
        """Return the covariance (K, K) across the border of a bone of this half-width.

        A border is not quite straight: its form is random over a length of about the bone's width.
        """
        apart = np.subtract.outer(self.edge.at, self.edge.at) / (2 * half_px)  # points are a pixel apart
        return self.edge.covariance_px2 + (UNEVEN * half_px) ** 2 * np.exp(-0.5 * apart**2)


def _axis(view: CalibratedView, image: Radiograph, drawn: Line) -> Line:
    """Return the axis between both edges, with the borders fitted to them. Raises NoBoneEdgeError, OutsideRegionError.

    Lines are straight on the view's plane; in a distorted image they are not.
    """
    if drawn.borders_px is None:
        raise NoBoneEdgeError("its axis is drawn, not its borders; draw both borders")
    first, second = drawn.borders_px
    half_px = float(np.linalg.norm(first.mean(axis=0) - second.mean(axis=0))) / 2
    borders = _Border.found(image, first, second), _Border.found(image, second, first)
    begin = common_begin(borders[0].edge, borders[1].edge)
    lines = [view.lines_of_sight(b.uv_px + (begin - b.edge.begin_px) * b.inward) for b in borders]
    along = _direction(lines)
    across = np.array([-along[1], along[0]])
    low, high = _common_part(lines, along)
    fits, covariances = [], []
    for border, seen in zip(borders, lines, strict=True):
        share = (seen.xy_mm @ along - low) / (high - low)
        solver = np.linalg.pinv(np.column_stack([1.0 - share, share]))  # of the places at both ends of the part
        by_offset = solver * (across @ (seen.jacobian @ border.inward).T)
        fits.append(solver @ (seen.xy_mm @ across))
        covariances.append(by_offset @ border.covariance_px2(half_px) @ by_offset.T)
    _refuse_taper(fits, high - low)
    plane, ends = lines[0].plane, np.outer([low, high], along)
    uv = np.stack([view.project(plane.to_space(ends + np.outer(fit, across))) for fit in fits])
    middle = view.project(plane.to_space(ends + np.outer(np.mean(fits, axis=0), across)))
    by_place = np.zeros((4, 2))
    by_place[:2, 0], by_place[2:, 1] = np.linalg.inv(view.lines_of_sight(middle).jacobian) @ across
    return Line(middle, drawn.sd_px, uv, by_place @ (covariances[0] + covariances[1]) / 4 @ by_place.T)


def _direction(lines: Sequence[LinesOfSight]) -> np.ndarray:
    """Return the unit vector (2,) along both borders, on the plane."""
    ways = []
    for seen in lines:
        way = np.linalg.svd(seen.xy_mm - seen.xy_mm.mean(axis=0))[2][0]
        ways.append(way * np.sign(way @ (seen.xy_mm[-1] - seen.xy_mm[0])))
    return unit(ways[0] + ways[1])


def _common_part(lines: Sequence[LinesOfSight], along: np.ndarray) -> tuple[float, float]:
    """Return the ends of the part along which both borders are shown. Raises NoBoneEdgeError."""
    places = [seen.xy_mm @ along for seen in lines]
    low, high = max(along_border.min() for along_border in places), min(along_border.max() for along_border in places)
    if high - low < max(np.ptp(along_border) for along_border in places) / 2:
        raise NoBoneEdgeError("its borders do not lie beside each other; draw both along the same part, or keep them")
    return float(low), float(high)


def _refuse_taper(fits: Sequence[np.ndarray], length_mm: float) -> None:
    """Raise NoBoneEdgeError for borders, given by their places at both ends, that are not nearly parallel."""
    widths = fits[0] - fits[1]
    taper = abs(float(np.rad2deg(np.arctan((widths[1] - widths[0]) / length_mm))))
    if taper > _MAX_TAPER_DEG:
        raise NoBoneEdgeError(
            f"its edges enclose {taper:.1f}° (at most {_MAX_TAPER_DEG:g}°), so it tapers or one is not the bone's; "
            "draw the borders where they are parallel, below the lesser trochanter, or keep them"
        )


def _no_shaft(views: Sequence[CalibratedView], lines: tuple[Line, Line]) -> str:
    """Return why the edges in two images are not those of one shaft; "" where they are."""
    anatomy = locate(views[:2], Aids(shaft=lines))
    if anatomy.shaft is None:
        return anatomy.why_absent("shaft")
    first, second = (_half_width_mm(view, line, anatomy.shaft) for view, line in zip(views[:2], lines, strict=True))
    if abs(first - second) <= MAX_UNEQUAL * (first + second) / 2:
        return ""
    return f"the edges are {2 * first:.1f} and {2 * second:.1f} mm apart in the two images, which is not one shaft"


def _half_width_mm(view: CalibratedView, line: Line, axis: Axis) -> float:
    """Return the mean distance of the lines of sight of a line's borders from its axis."""
    assert line.borders_px is not None  # noqa: S101 - it was fitted
    seen = view.lines_of_sight(line.borders_px.reshape(4, 2))
    return float(nearest_approach(seen.focal_point_mm, seen.directions, axis.ends_mm[0], axis.direction).gap_mm.mean())
