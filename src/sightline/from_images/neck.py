"""Fits the drawn borders of a neck to the edges that the images show: its axis passes through the head's centre, midway
between both edges where they leave the head.

The edges are compared at equal distances from the head's centre. Near the head both are alike. Towards the trochanters
they bend away from the axis, one more than the other, so that the middle between them leaves it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Legendre
from numpy.polynomial.legendre import legvander

from sightline.calibration.bead_view import bead_shadows_px
from sightline.calibration.view import CalibratedView
from sightline.detection.bone_edges import (
    BoneEdge,
    NoBoneEdgeError,
    common_begin,
    find_bone_edge,
    points_of_border,
)
from sightline.from_images.head_and_shaft import MIN_RADIUS_PX, fitted_or_kept
from sightline.imaging import Radiograph
from sightline.planning.bone.aids import Aids, Circle, Line
from sightline.planning.bone.anatomy import Anatomy, locate
from sightline.planning.bone.drawings import Axis
from sightline.planning.bone.head import Sphere
from sightline.planning.procedures.proposal import MIN_ACROSS

_CURVE = 0.12  # depth of a border's curve over its length, at which the search begins: half of the deepest [twin]
# Nearer to the beam head and trochanter cover the neck: at 68° the outline's narrowest place is 0.4 mm beside the
# neck's, at 63° 0.9 mm [twin].
_MIN_ANGLE_DEG = 70.0
# Reach of the fit's profiles, and share of a border beside which balls may lie within it: they pass for bone. Where
# there were more, directions of eight necks between plates had errors of 1.5 times the stated ones [twin].
_BEADS_PX, _MAX_BEADS = 14.0, 0.1
# The middle between the edges begins to leave the axis 0.13 radii of the head nearer to it than the narrowest place,
# with an s.d. of 0.11 rad a radius: 0.8° at the narrowest place [twin].
_BENT, _BEND_RAD = 0.13, 0.11
# S.d. of an edge's place in PA and lateral image, random over lengths of half a width, over the half-width. Lateral
# images have more tissue in the beam: with 0.01 too, 21 necks there had errors of 1.4 times the stated ones [twin].
_UNEVEN = 0.01, 0.018
_WIDTHS = 0.45, 0.9  # of the neck over the head's; adults have about 0.55 to 0.85 [ours]
# Distances of the edges' narrowest place from the head's centre, in radii. Where it is nearer, the trochanter covers
# the neck up to the head, and the middle of the edges is 1 to 4° off everywhere [twin].
_NARROWEST = 1.15, 2.0
# Distances from the head's centre at which the edges are compared, in radii, and the span of them that both edges must
# have in common [ours]: nearer is the head's own rim, farther the trochanter.
_BEGIN, _END, _MIN_SPAN = 1.04, 1.4, 0.06
_RADII = 12  # distances at which the edges are compared
_DEGREE = 4  # of an edge's form
_STEPS = 101  # places along an edge
_TINY = 1e-10  # rad², so that the covariance of smooth edges can be inverted


def fit_neck(
    views: Sequence[CalibratedView],
    images: Sequence[Radiograph],
    drawn: tuple[Line, Line],
    head: tuple[Circle, Circle],
) -> tuple[tuple[Line, Line], dict[str, str]]:
    """Return a neck's axis between the edges that the images show within 12 px of its borders, which are drawn from the
    head past the narrowest place, and what was kept.

    It passes through the head's centre, as drawn or fitted. Its covariances are those of the fits; they have no part
    along the axis. `borders_px` are parallel to it, as far apart as the neck is wide where it is narrowest. A line is
    kept where it was drawn without borders, where the beam does not cross the neck, where balls of the frame lie beside
    a border, where its image shows no clear edge there, or two, and where the edges are not a neck's; both where head
    or drawn axis are not located, or the head's outlines do not agree. The reason stands at the view's name. `views`,
    `images`: PA and lateral first.
    """
    anatomy = locate(views[:2], Aids(head=head, neck=drawn))
    if missing := _missing(anatomy):
        return drawn, dict.fromkeys([view.name for view in views[:2]], missing)
    assert anatomy.head is not None and anatomy.neck is not None  # noqa: S101 - nothing is missing
    head_mm, neck_mm = anatomy.head, anatomy.neck
    uneven = dict(zip([view.name for view in views[:2]], _UNEVEN, strict=True))

    def fit(view: CalibratedView, image: Radiograph, line: Line) -> Line:
        _refuse_covered(view, neck_mm)
        return _axis(view, image, line, head_mm, uneven[view.name])

    return fitted_or_kept(views, images, drawn, fit)


def _missing(anatomy: Anatomy) -> str:
    """Return why the head or the drawn axis cannot be used; "" where both can."""
    for name in ("head", "neck"):
        if name not in anatomy.at:
            return anatomy.why_absent(name)
    agreement = anatomy.head_agreement
    return "" if agreement is None or agreement.passed else agreement.sentence


def _refuse_covered(view: CalibratedView, neck: Axis) -> None:
    """Raise NoBoneEdgeError where the beam at the neck is too nearly along it."""
    beam = neck.ends_mm.mean(axis=0) - view.focal_point_mm
    angle = float(np.rad2deg(np.arccos(min(abs(neck.direction @ beam) / np.linalg.norm(beam), 1.0))))
    if angle < _MIN_ANGLE_DEG:
        raise NoBoneEdgeError(
            f"head and trochanter cover the neck: the beam meets it at {angle:.0f}° (at least "
            f"{_MIN_ANGLE_DEG:.0f}° is needed)"
        )


def _refuse_beads(view: CalibratedView, borders_px: np.ndarray) -> None:
    """Raise NoBoneEdgeError where balls of the frame lie beside too much of a border."""
    beads, along = bead_shadows_px(view), np.linspace(0.0, 1.0, _STEPS)[:, None]
    for first, second in borders_px:
        away = np.linalg.norm((first + along * (second - first))[:, None] - beads[:, :2], axis=-1)
        share = float((away < beads[:, 2] + _BEADS_PX).any(axis=1).mean())
        if share > _MAX_BEADS:
            raise NoBoneEdgeError(
                f"balls of the frame lie beside {share:.0%} of a border (at most {_MAX_BEADS:.0%}); move the frame or "
                "the beam, or keep the axis as drawn"
            )


@dataclass(frozen=True, eq=False)
class _Border:
    """A border's edge: N points `uv_px` (N, 2) about a pixel apart, px, the unit vectors `inward` (N, 2) there, and the
    edge near them."""

    uv_px: np.ndarray
    inward: np.ndarray
    edge: BoneEdge

    @staticmethod
    def found(image: Radiograph, ends: np.ndarray, other: np.ndarray) -> "_Border":
        """Return the edge near a border drawn from end to end (2, 2), the `other` border beside it.

        The first search begins at a curve between both ends, the second at the edge of the first, across it. Raises
        NoBoneEdgeError.
        """
        uv, inward, along = points_of_border(ends, other, MIN_RADIUS_PX)
        forms, depth_px = legvander(along, _DEGREE), _CURVE * np.linalg.norm(ends[1] - ends[0])
        uv = uv + (depth_px * (1.0 - along**2))[:, None] * inward
        first = find_bone_edge(image, uv, np.broadcast_to(inward, uv.shape), forms[:, :3], forms[:, 3:])
        by_form = np.linalg.lstsq(forms[first.at], first.offset_px - first.begin_px, rcond=None)[0]
        uv = uv + (forms @ by_form)[:, None] * inward
        tangent = np.gradient(uv, axis=0)
        across = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.linalg.norm(tangent, axis=1)[:, None]
        across *= np.sign(across @ inward)[:, None]
        return _Border(uv, across, find_bone_edge(image, uv, across, forms[:, :2], forms[:, 2:]))


@dataclass(frozen=True, eq=False)
class _Edge:
    """An edge on the view's plane at S places, mm: distances from the head's centre along and across the neck (S,), the
    derivative of the one across by the one along, and the covariance (S, S) of the one across."""

    along_mm: np.ndarray
    across_mm: np.ndarray
    slope: np.ndarray
    covariance_mm2: np.ndarray

    @staticmethod
    def of(view: CalibratedView, border: _Border, begin_px: float, centre: np.ndarray, axes: np.ndarray) -> "_Edge":
        """Return the edge that begins so far inwards of its clearest fall. `centre` (2,): of the head, mm; `axes`
        (2, 2): unit vectors along and across the neck. Raises OutsideRegionError."""
        at, inward = border.edge.at, border.inward[border.edge.at]
        offset_px = border.edge.offset_px + begin_px - border.edge.begin_px
        seen = view.lines_of_sight(border.uv_px[at] + offset_px[:, None] * inward)
        along, across = axes @ (seen.xy_mm - centre).T
        series = Legendre.fit(along, across, _DEGREE)
        steps = np.linspace(along.min(), along.max(), _STEPS)
        by_across = _forms(series, steps) @ np.linalg.pinv(_forms(series, along))
        by_offset = by_across * np.einsum("i,kij,kj->k", axes[1], seen.jacobian, inward)
        covariance = by_offset @ border.edge.covariance_px2 @ by_offset.T
        return _Edge(steps, series(steps), series.deriv()(steps), covariance)

    @property
    def radii_mm(self) -> np.ndarray:
        """(S,) distances from the head's centre."""
        return np.hypot(self.along_mm, self.across_mm)

    @property
    def leaving(self) -> np.ndarray:
        """(S,) derivative of the distance from the head's centre by the one along the neck; 0 along the head's rim."""
        return (self.along_mm + self.across_mm * self.slope) / self.radii_mm


def _forms(series: Legendre, along: np.ndarray) -> np.ndarray:
    """Return the values (K, degree + 1) of each term of a series."""
    offset, scale = series.mapparms()
    return legvander(offset + scale * along, _DEGREE)


def _axis(view: CalibratedView, image: Radiograph, drawn: Line, head: Sphere, uneven: float) -> Line:
    """Return the axis from the head's centre between both edges; `uneven`: one of _UNEVEN.

    Raises NoBoneEdgeError, OutsideRegionError.
    """
    if drawn.borders_px is None:
        raise NoBoneEdgeError("its axis is drawn, not its borders; draw both borders")
    first, second = drawn.borders_px
    _refuse_beads(view, drawn.borders_px)
    borders = _Border.found(image, first, second), _Border.found(image, second, first)
    begin = common_begin(borders[0].edge, borders[1].edge)
    centre, by_centre = _on_plane(view, head.centre_mm)
    radius = float(np.linalg.norm(by_centre, 2)) * head.radius_mm
    lines = view.lines_of_sight(drawn.uv_px)
    towards = lines.xy_mm.mean(axis=0) - centre
    angle = float(np.arctan2(towards[1], towards[0]))
    axes = _axes(angle)
    edges = [_Edge.of(view, border, begin, centre, axes) for border in borders]
    neck = _narrowest(edges, radius)
    variance = 0.0
    if head.covariance_mm2 is not None:
        by_head = axes[1] @ by_centre
        variance = float(by_head @ head.covariance_mm2[:3, :3] @ by_head)
    turn, spread = _direction(edges, radius, neck, uneven, variance)
    along, across = _axes(angle + turn)
    places = neck.place_mm + np.array([-0.5, 0.5]) * neck.width_mm  # of both ends, from the head's centre
    ends = centre + np.outer(places, along)
    sides = np.stack([ends + side * neck.width_mm / 2 * across for side in (1.0, -1.0)])
    uv, borders_px = view.project(lines.plane.to_space(ends)), view.project(lines.plane.to_space(sides.reshape(4, 2)))
    by_across = np.zeros((4, 2))
    by_across[:2, 0], by_across[2:, 1] = np.linalg.inv(view.lines_of_sight(uv).jacobian) @ across
    by_both = by_across @ np.column_stack([np.ones(2), places])
    return Line(uv, drawn.sd_px, borders_px.reshape(2, 2, 2), by_both @ spread @ by_both.T)


def _axes(angle: float) -> np.ndarray:
    """Return unit vectors (2, 2) at an angle and across it."""
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


@dataclass(frozen=True)
class _Narrowest:
    """The narrowest place: distance of its middle from the head's centre, mm, and that of the edges, in radii."""

    place_mm: float
    radii: float
    width_mm: float


def _narrowest(edges: Sequence[_Edge], radius_mm: float) -> _Narrowest:
    """Return the place where both edges are nearest to each other. Raises NoBoneEdgeError where it is not a neck's."""
    points = [np.column_stack([edge.along_mm, edge.across_mm]) for edge in edges]
    apart = np.linalg.norm(points[0][:, None] - points[1], axis=-1)
    i, j = np.unravel_index(apart.argmin(), apart.shape)
    if not (0 < i < _STEPS - 1 and 0 < j < _STEPS - 1):
        raise NoBoneEdgeError(
            "its edges are not nearest to each other between the ends of the drawn borders; draw both borders from the "
            "head past the narrowest place of the neck, or keep them"
        )
    width, wide = float(apart[i, j]), float(apart[i, j]) / (2 * radius_mm)
    if not _WIDTHS[0] < wide < _WIDTHS[1]:
        raise NoBoneEdgeError(
            f"it is {wide:.2f} times as wide as the head (a neck: {_WIDTHS[0]:g} to {_WIDTHS[1]:g} times), so one of "
            "its edges is not the neck's; draw the borders again, or keep them"
        )
    far = float(edges[0].radii_mm[i] + edges[1].radii_mm[j]) / (2 * radius_mm)
    if not _NARROWEST[0] < far < _NARROWEST[1]:
        raise NoBoneEdgeError(
            f"its edges are nearest to each other {far:.2f} radii of the head from the head's centre (at a neck "
            f"{_NARROWEST[0]:g} to {_NARROWEST[1]:g}), so the trochanter covers one, or it is not the neck's; rotate "
            "the beam, or keep the axis as drawn"
        )
    return _Narrowest(float(np.linalg.norm(points[0][i] + points[1][j])) / 2, far, width)


def _direction(
    edges: Sequence[_Edge], radius_mm: float, neck: _Narrowest, uneven: float, centre_mm2: float
) -> tuple[float, np.ndarray]:
    """Return the axis's angle, and the covariance (2, 2) of the head's centre across the neck, mm, and of the angle.

    `uneven`: one of _UNEVEN; `centre_mm2`: variance of the head's centre across the neck. Raises NoBoneEdgeError.
    """
    leaves = [np.flatnonzero(edge.leaving > MIN_ACROSS) for edge in edges]
    if min(map(len, leaves)) < _STEPS / 4:
        raise NoBoneEdgeError(
            "its edges run along the head's rim; draw both borders from the head past the narrowest place of the neck, "
            "or keep them"
        )
    low = max(edge.radii_mm[rows[0]] for edge, rows in zip(edges, leaves, strict=True))
    high = min(edge.radii_mm[rows[-1]] for edge, rows in zip(edges, leaves, strict=True))
    low, high = max(low, _BEGIN * radius_mm), min(high, _END * radius_mm)
    if high - low < _MIN_SPAN * radius_mm:
        raise NoBoneEdgeError("its borders do not lie beside each other; draw both along the same part, or keep them")
    radii = np.linspace(low, high, _RADII)
    middle, by_centre = np.zeros(_RADII), np.zeros(_RADII)
    covariance = _bend(radii / radius_mm - neck.radii + _BENT)
    for edge, rows in zip(edges, leaves, strict=True):
        at = rows[np.searchsorted(edge.radii_mm[rows], radii).clip(0, len(rows) - 1)]
        middle += np.arctan2(edge.across_mm[at], edge.along_mm[at]) / 2
        by_across = 0.5 / (edge.leaving[at] * edge.radii_mm[at])  # at a constant distance from the head's centre
        by_centre -= by_across
        apart = np.subtract.outer(edge.along_mm[at], edge.along_mm[at]) / (neck.width_mm / 2)
        form = (uneven * neck.width_mm / 2) ** 2 * np.exp(-np.abs(apart))
        covariance += by_across[:, None] * (edge.covariance_mm2[np.ix_(at, at)] + form) * by_across
    weights = np.linalg.solve(covariance + _TINY * np.eye(_RADII), np.ones(_RADII))
    weights /= weights.sum()
    by_head = float(weights @ by_centre)  # not weighted with: a bend would pass for an error of the head
    shared, own = by_head * centre_mm2, float(weights @ covariance @ weights) + by_head**2 * centre_mm2
    return float(weights @ middle), np.array([[centre_mm2, shared], [shared, own]])


def _bend(past: np.ndarray) -> np.ndarray:
    """Return the covariance (K, K) of the angle between the axis and the middle of both edges, so far `past` the place
    where it begins, in radii."""
    bent = np.maximum(past, 0.0)
    return _BEND_RAD**2 * np.outer(bent, bent)


def _on_plane(view: CalibratedView, point_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the view's plane shows a point (3,), (2,) mm, and the derivative (2, 3) by the point."""
    steps = np.vstack([np.zeros(3), np.eye(3), -np.eye(3)]) / 2
    xy = view.lines_of_sight(view.project(point_mm + steps)).xy_mm
    return xy[0], (xy[1:4] - xy[4:]).T
