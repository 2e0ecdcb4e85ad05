"""The axis of a nail's transverse hole from the edges seen in two or more views.

The nail is a cylinder, bent a little; the hole is a cylinder through it. Two conditions hold for lines of sight: one
through the nail's outline is tangent to the nail, at one radius from its axis; one through a rim meets the nail's
surface at one hole's radius from the hole's axis. Rims are the curves where both cylinders intersect, not circles: on
a nail of 11 mm with holes of 5 mm they are 0.6 mm deep. All points of all views are adjusted together, weighted by the
joint covariance of their lines of sight and of the edges.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sightline.calibration.view import SOURCES, CalibratedView
from sightline.common.checks import Check, failed
from sightline.common.fitting import MAD_TO_SD
from sightline.common.geometry.covariance import TWO_SIDED_999, ellipsoid_factor
from sightline.common.geometry.lines import across, nearest_approach, unit
from sightline.errors import ReconstructionRefusedError, UnusableInputError
from sightline.planning.nail.expected import LocalCamera, through_surface
from sightline.planning.nail.result import Hole, HolePose, Nail
from sightline.planning.points.gaps import CONFIDENCE
from sightline.planning.points.lines_of_sight import Sights, joint_covariance
from sightline.planning.points.results import error_unknown

MIN_ANGLE_RAD = np.deg2rad(20.0)
MIN_RIM_POINTS = 8  # [ours] of each rim, in all views together: an ellipse has five unknowns
MIN_VIEW_POINTS = 5  # of both rims in a view
MIN_OUTLINE_POINTS = 4  # of each outline
# Prior s.d. of the nail's curvature, 1/mm: 2° over its last 100 mm; three times as much is beyond the model [ours].
BEND_PER_MM = float(np.deg2rad(2.0)) / 100.0
_MAX_BEND = 3.0
_MAX_SIZE_MM = 0.12  # of a radius: sizes differ by 0.5 mm in diameter; half of the difference is refused [ours]
_FREE = 1e-6  # precision of a size that nothing states, 1/mm²
# Of the hole from the normal of the nail, and from its axis [ours]: nails are made ten times better.
_MAX_TILT_RAD, _MAX_OFF_MM = np.deg2rad(3.0), 0.6
_OUTLIER = 4.0  # s.d.
_MIN_USED = 0.6  # [ours] share of the rims' points in a view that fit: with fewer, another edge may explain as many
_ITERATIONS = 40
_CONVERGED = 1e-3  # mm; of directions over 5 mm

# The state of the fit: nail (point, direction), hole (point, direction), curvature, radii of hole, outline and walls.
_NAIL, _ALONG, _HOLE, _AXIS, _BEND = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 14)
_RADIUS, _OUTER, _WALL, _SIZES = 14, 15, 16, slice(14, 17)
_STEPS = np.array([1e-3] * 2 + [1e-5] * 2 + [1e-3] * 2 + [1e-5] * 2 + [1e-6] * 2 + [1e-3] * 3)  # mm, rad, 1/mm
_LEVER_MM = np.array([1.0, 1.0, 5.0, 5.0] * 2)
_ENTRY, _EXIT = 2, 3  # kinds of points; 0 and 1: outlines
_TURNS, _TURN_STEPS = 5, np.array([1e-3, 1e-4])  # iterations of `turned_to_rims`; mm and rad


class EdgeSeen(Protocol):
    """Points of one edge in one image, px; a point measures nothing along the edge."""

    @property
    def uv_px(self) -> np.ndarray:
        """(N, 2)."""
        ...

    @property
    def variance_px2(self) -> np.ndarray:
        """(N,) variance of each point across the edge."""
        ...

    @property
    def common_px(self) -> float:
        """S.d. of an error across the edge that all its points share, outwards; both rims of a view share one."""
        ...


@dataclass(frozen=True, eq=False)
class Edge:
    """An `EdgeSeen` from numbers."""

    uv_px: np.ndarray
    variance_px2: np.ndarray
    common_px: float = 0.0


@dataclass(frozen=True, eq=False)
class HoleSeen:
    """The edges of a nail and of one of its holes in one image: the nail's outlines beside the hole, and both rims.

    `entry`, `exit`: the rim nearer to the X-ray source of the first view, and the other one.
    """

    outlines: tuple[EdgeSeen, EdgeSeen]
    entry: EdgeSeen
    exit: EdgeSeen

    @property
    def edges(self) -> tuple[EdgeSeen, ...]:
        """Both outlines, entry rim, exit rim."""
        return (*self.outlines, self.entry, self.exit)


def fit_hole(
    views: Sequence[CalibratedView],
    seen: Sequence[HoleSeen],
    nail: Nail | None = None,
    start: HolePose | None = None,
) -> Hole:
    """Return the axis of a hole from its edges in two or more views (`seen`, in the order of the views).

    `start`: about where it is; by default from the edges.
    Raises UnusableInputError; ErrorUnknownError where a view's error is unknown; OutsideRegionError; and
    ReconstructionRefusedError for views less than 20° apart, one rim only, holes of another nail, and a nail that is
    bent beyond the model.
    """
    nail = nail or Nail()
    points = _Points.of(views, seen)
    kept, solved = _without_outliers(points, _fitted(points, _start(points, nail, start), nail), nail)
    _refuse_one_rim(points, kept)
    _refuse_another(solved, nail)
    ends, by_parameters = _by_parameters(_crossings, solved.state)
    covariance = by_parameters @ solved.covariance @ by_parameters.T
    disagreement = rims_disagree(
        ends, covariance, by_parameters @ solved.gain, solved.left, solved.redundant, points.rims(kept)
    )
    covariance = covariance * max(1.0, disagreement)
    counts = points.counts(np.ones(len(kept), dtype=bool))
    return Hole(
        entry_mm=ends[:3],
        exit_mm=ends[3:],
        covariance_mm2=covariance,
        budget_mm2=_budget(points, solved, kept, by_parameters, covariance),
        nail_mm=solved.state[_NAIL],
        nail_direction=solved.state[_ALONG],
        given=counts,
        kept=points.counts(kept),
        checks=(
            *_checks(solved),
            _rims_used(points, kept),
            *(check for view in views for check in failed(view.checks)),
        ),
        nail=nail,
    )


@dataclass(frozen=True, eq=False)
class _Points:
    """All N edge points: kind and view (N,), variance (N,) and common error (N,), px; and their lines of `sights`.

    `measured` (Z,): the numbers of the lines (focal point, then xy of each line, for every view), mm; `covariance`
    (Z, Z) of these; `columns` (N, 5): the numbers that each point depends on; `origin_mm`, `axes`: of each line's
    plane.
    """

    sights: Sights
    names: tuple[str, ...]
    kind: np.ndarray
    view: np.ndarray
    variance_px2: np.ndarray
    common_px: np.ndarray
    measured: np.ndarray
    covariance: np.ndarray
    columns: np.ndarray
    origin_mm: np.ndarray
    axes: np.ndarray
    jacobian: np.ndarray

    @staticmethod
    def of(views: Sequence[CalibratedView], seen: Sequence[HoleSeen]) -> "_Points":
        if len(views) < 2 or len(views) != len(seen):
            raise UnusableInputError(f"{len(views)} views and the edges of {len(seen)}; give two views or more")
        edges = [edge for view in seen for edge in view.edges]
        sizes = [len(edge.uv_px) for edge in edges]
        if min(n for k, n in enumerate(sizes) if k % 4 < 2) < MIN_OUTLINE_POINTS:
            raise ReconstructionRefusedError(
                f"an outline of the nail has fewer than {MIN_OUTLINE_POINTS} points; draw its stroke longer, along an "
                "edge that nothing hides"
            )
        pixels = [np.concatenate([edge.uv_px for edge in view.edges]) for view in seen]
        sights = Sights.of(views, [{"edges": (uv, np.zeros((2 * len(uv), 2 * len(uv))))} for uv in pixels])
        covariance = sights.covariance
        if covariance is None:
            raise error_unknown()
        each = np.array([len(uv) for uv in pixels])
        view = np.repeat(np.arange(len(views)), each)
        start = np.cumsum([0, *(3 + 2 * each)])[view][:, None]
        row = np.concatenate([np.arange(n) for n in each])[:, None]
        planes = [sight.plane for sight in sights.lines]
        return _Points(
            sights,
            tuple(sight.view for sight in sights.lines),
            np.repeat(np.tile(np.arange(4), len(views)), sizes),
            view,
            np.concatenate([edge.variance_px2 for edge in edges]),
            np.repeat([edge.common_px for edge in edges], sizes),
            sights.values,
            covariance,
            start + np.hstack([np.broadcast_to(np.arange(3), (len(view), 3)), 3 + 2 * row, 4 + 2 * row]),
            np.array([plane.origin_mm for plane in planes])[view],
            np.array([plane.axes for plane in planes])[view],
            np.concatenate([sight.jacobian for sight in sights.lines]),
        )

    @cached_property
    def with_columns(self) -> np.ndarray:
        """(Z, N, 5): covariance of all numbers with those that each point depends on."""
        return self.covariance[:, self.columns]

    def counts(self, kept: np.ndarray) -> np.ndarray:
        """Return (V, 4) int: how many points of each view and kind are kept."""
        counts = np.zeros((len(self.names), 4), dtype=int)
        np.add.at(counts, (self.view[kept], self.kind[kept]), 1)
        return counts

    def rims(self, kept: np.ndarray) -> list[np.ndarray]:
        """Return the places of each rim's points of each view among the kept ones, in their order along the rim."""
        kind, view = self.kind[kept], self.view[kept]
        return [
            np.flatnonzero((view == v) & (kind == which)) for v in range(len(self.names)) for which in (_ENTRY, _EXIT)
        ]

    def rays(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return focal points and points on the planes, (N, 3) each, of the lines' numbers (Z,)."""
        own = numbers[self.columns]
        return own[:, :3], self.origin_mm + np.einsum("na,nax->nx", own[:, 3:], self.axes)

    def by_numbers(self, state: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Return the derivatives (N, 5) of the residuals by the numbers in `columns`."""
        h = 1e-3
        focal, points = self.rays(numbers)
        moves = h * np.concatenate(
            [np.broadcast_to(np.eye(3)[:, None], (3, *focal.shape)), np.moveaxis(self.axes, 1, 0)]
        )
        signed = np.stack([moves, -moves])  # (2, 5, N, 3)
        of_focal = np.arange(5)[:, None, None] < 3
        values = _residuals(
            state[None],
            (focal + signed * of_focal).reshape(10, -1, 3),
            (points + signed * ~of_focal).reshape(10, -1, 3),
            self.kind,
        )
        return ((values[:5] - values[5:]) / (2 * h)).T

    def noise(self, by: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the variance (N,) of each residual from its point's own error, and a factor (N, G) of common errors.

        Each outline has a common error of its own; both rims of a view share one. `by`: as of `by_numbers`.
        """
        scale = np.linalg.norm(np.einsum("na,nab->nb", by[:, 3:], self.jacobian), axis=1)
        group = 3 * self.view + np.minimum(self.kind, _ENTRY)
        common = (scale * self.common_px)[:, None] * (group[:, None] == np.unique(group))
        return self.variance_px2 * scale**2, common


def _residuals(states: np.ndarray, focal: np.ndarray, points: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Return (K, N), mm, for states (K or 1, 17) and lines of sight (K or 1, N, 3): of an outline, distance from the
    nail's axis minus the radius; of a rim, the same of the hole where the line meets the nail's surface."""
    nail, along, hole, axis = states[:, _NAIL], unit(states[:, _ALONG]), states[:, _HOLE], unit(states[:, _AXIS])
    ray = unit(points - focal)
    moment = np.cross(focal, ray)
    cosine = _dot(ray, along)
    ahead = (focal * ray).sum(-1) - _dot(ray, nail)
    beside = _dot(focal, along) - (nail * along).sum(-1)[:, None]
    sine2 = 1 - cosine**2
    place = (beside - cosine * ahead) / sine2
    # Distance between both lines, straight and bent, times the sine of the angle between them.
    straight = _dot(moment, along) - _dot(ray, np.cross(along, nail))
    bent = straight - 0.5 * place**2 * _dot(ray, np.cross(along, _bend(states)))
    outline = np.abs(bent) / np.sqrt(sine2) - states[:, _OUTER, None]
    # Where the line meets the surface, it has the distance of the radius from the axis.
    root = np.sqrt(np.maximum(sine2 * states[:, _WALL, None] ** 2 - straight**2, 1e-12))
    forwards = np.where(_dot(ray, axis) > 0, 1.0, -1.0) * np.where(kind == _EXIT, 1.0, -1.0)
    length = (forwards * root - ahead + cosine * beside) / sine2
    from_hole = focal - hole[:, None] + length[..., None] * ray
    square = np.einsum("kni,kni->kn", from_hole, from_hole) - _dot(from_hole, axis) ** 2
    return np.where(kind < _ENTRY, outline, np.sqrt(np.maximum(square, 0.0)) - states[:, _RADIUS, None])


def _dot(vectors: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Return (K, N): products of vectors (K or 1, N, 3) with one vector (K or 1, 3) each."""
    return (vectors @ own[..., None])[..., 0]


def _bend(states: np.ndarray) -> np.ndarray:
    """Return the curvature vectors (K, 3), 1/mm: components along and across the first hole axis's plane."""
    along = unit(states[:, _ALONG])
    first = unit(across(states[:, _AXIS], along))
    return states[:, 12:13] * first + states[:, 13:14] * np.cross(along, first)


def _tangents(state: np.ndarray) -> np.ndarray:
    """Return (17, 13): the changes of the state by its parameters: nail 4, hole 4, curvature 2, sizes 3."""
    tangents = np.zeros((17, 13))
    nail, hole = (np.linalg.svd(unit(state[at])[None])[2][1:].T for at in (_ALONG, _AXIS))
    for column, (at, basis) in enumerate(((_NAIL, nail), (_ALONG, nail), (_HOLE, hole), (_AXIS, hole))):
        tangents[at, 2 * column : 2 * column + 2] = basis
    tangents[12:, 8:] = np.eye(5)
    return tangents


def _design(points: _Points, state: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals (N,) and their derivatives (N, 13) by the parameters."""
    rays = points.rays(numbers)
    return _by_parameters(lambda states: _residuals(states, *rays, points.kind), state)


def _by_parameters(function: Callable[[np.ndarray], np.ndarray], state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return value (m,) and derivative (m, 13) by the parameters of a function that maps states (K, 17) to (K, m)."""
    moves = (_tangents(state) * _STEPS).T
    values = function(np.concatenate([state[None], state + moves, state - moves]))
    return values[0], ((values[1:14] - values[14:]) / (2 * _STEPS[:, None])).T


def _prior(state: np.ndarray, nail: Nail) -> tuple[np.ndarray, np.ndarray]:
    """Return the parameters' distance (13,) from their prior, and the prior's precision (13,)."""
    precision = np.concatenate([np.zeros(8), np.full(2, BEND_PER_MM**-2), np.full(3, nail.sd_mm**-2)])
    return np.concatenate([np.zeros(8), state[_BEND], state[_SIZES] - nail.radii_mm]), precision


@dataclass(frozen=True, eq=False)
class _Solved:
    """A least-squares step: the state (17,) and the lines' numbers (Z,) after it, the covariance (13, 13) of the
    parameters, and what checks need.

    `gain` (13, K): response of the parameters to the residuals of the K points used; `left` (K,): their weighted
    residuals, and `redundant` (K, K) the covariance of these.
    `own` (N,): each point's own error over its s.d., as far as the lines' errors do not explain it; `standard` (N,):
    residual over its s.d. given all others, 0 where not used; `freely`: each size without its own prior, minus the
    stated one, and its s.d. (2, 3); `step`: largest change, mm.
    """

    state: np.ndarray
    numbers: np.ndarray
    covariance: np.ndarray
    gain: np.ndarray
    left: np.ndarray
    redundant: np.ndarray
    own: np.ndarray
    standard: np.ndarray
    chi_square: float
    freedom: int
    freely: np.ndarray
    step: float


def _solved(points: _Points, nail: Nail, at: tuple[np.ndarray, np.ndarray], inflation: np.ndarray) -> _Solved:
    """Return one step from a state and the lines' numbers (`at`).

    Both are unknowns (Gauss-Helmert): residuals are linearised where the lines are after the adjustment, because the
    error of a frame may be large beside that of an edge. `inflation` (N,): of the points' variances; inf: not used.
    """
    state, numbers = at
    kept = np.isfinite(inflation)
    by = points.by_numbers(state, numbers)
    residual, design = _design(points, state, numbers)
    residual = residual + (by * (points.measured - numbers)[points.columns]).sum(axis=1)
    to_lines = np.einsum("znc,nc->zn", points.with_columns, by)
    variance, common = points.noise(by)
    covariance = np.einsum("nc,ncm->nm", by, to_lines[points.columns]) + common @ common.T
    covariance[np.diag_indices(len(kept))] += variance * np.where(kept, inflation, 1.0)
    residual, design = residual[kept], design[kept]
    factor = cho_factor(covariance[np.ix_(kept, kept)])
    weighted = cho_solve(factor, np.column_stack([design, residual, np.eye(len(residual))]))
    by_design, by_residual, inverse = weighted[:, :13], weighted[:, 13], weighted[:, 14:]
    off, precision = _prior(state, nail)
    normal, right = design.T @ by_design, -design.T @ by_residual
    free = np.where(np.eye(13, dtype=bool)[10:], _FREE, precision)  # each size in turn
    try:
        own, freed = np.linalg.inv(normal + np.diag(precision)), np.linalg.inv(normal + free[:, None] * np.eye(13))
    except np.linalg.LinAlgError:
        raise _undetermined() from None
    step = own @ (right - precision * off)
    left = np.zeros(len(kept))
    left[kept] = by_residual + by_design @ step
    redundant = inverse - by_design @ own @ by_design.T
    standard = np.zeros(len(kept))
    standard[kept] = left[kept] / np.sqrt(np.maximum(np.diag(redundant), 1e-12))
    after = off + step
    sizes = [
        (off + inverse @ (right - weak * off))[k] for k, (inverse, weak) in enumerate(zip(freed, free, strict=True), 10)
    ]
    return _Solved(
        _anchored(state + _tangents(state) @ step),
        points.measured - to_lines @ left,
        own,
        own @ by_design.T,
        left[kept],
        redundant,
        np.sqrt(variance) * np.where(kept, inflation, 0.0) * left,
        standard,
        float((residual + design @ step) @ left[kept] + precision @ after**2),
        int(kept.sum()) - 8,
        np.stack([sizes, np.sqrt(np.diagonal(freed, axis1=1, axis2=2)[range(3), range(10, 13)])]),
        float(np.abs(step[:8] * _LEVER_MM).max()),
    )


def _fitted(points: _Points, state: np.ndarray, nail: Nail) -> _Solved:
    """Return the adjustment with weights that a part of wrong points does not disturb."""
    at, inflation = (state, points.measured), np.ones(len(points.kind))
    for iteration in range(_ITERATIONS):
        solved = _solved(points, nail, at, inflation)
        at = solved.state, solved.numbers
        if not np.isfinite(solved.state).all():
            break
        spread = max(1.0, MAD_TO_SD * float(np.median(np.abs(solved.own))))
        inflation = 1 + (solved.own / (2.0 * spread)) ** 2
        if iteration > 0 and solved.step < 30 * _CONVERGED:
            return solved
    raise _undetermined()


def _without_outliers(points: _Points, start: _Solved, nail: Nail) -> tuple[np.ndarray, _Solved]:
    """Return which points (N,) fit the others, and the adjustment of these alone."""
    at, kept = (start.state, start.numbers), np.abs(start.own) < 2 * _OUTLIER
    for _ in range(_ITERATIONS):
        _refuse_one_rim(points, kept)
        solved = _solved(points, nail, at, np.where(kept, 1.0, np.inf))
        at = solved.state, solved.numbers
        off = np.abs(solved.standard)
        if off.max() > _OUTLIER:
            kept &= off < max(_OUTLIER, 0.7 * float(off.max()))
        elif solved.step < _CONVERGED:
            return kept, solved
    raise _undetermined()


def _anchored(state: np.ndarray) -> np.ndarray:
    """Return the state with unit directions, and the points of nail and hole where both axes are closest."""
    anchored = state.copy()
    anchored[_ALONG], anchored[_AXIS] = unit(state[_ALONG]), unit(state[_AXIS])
    meeting = nearest_approach(anchored[_NAIL], anchored[_ALONG], anchored[_HOLE], anchored[_AXIS])
    anchored[_NAIL], anchored[_HOLE] = meeting.first_mm, meeting.second_mm
    return anchored


def _start(points: _Points, nail: Nail, pose: HolePose | None) -> np.ndarray:
    """Return a first state (17,). Raises ReconstructionRefusedError for views that determine none."""
    focal_mm, on_plane_mm = points.rays(points.measured)
    rays = unit(on_plane_mm - focal_mm)
    beams = np.array([unit(rays[points.view == v].mean(axis=0)) for v in range(len(points.names))])
    i, j = farthest_apart(beams)
    rims = points.kind >= _ENTRY
    everything = np.ones(len(rims), dtype=bool)
    for name, shown in zip(points.names, points.counts(everything)[:, _ENTRY:].sum(axis=1), strict=True):
        if shown < MIN_VIEW_POINTS:
            raise ReconstructionRefusedError(
                f"the view {name!r} shows {shown} points of the hole's rims (at least {MIN_VIEW_POINTS} are "
                "needed): the beam crosses the hole too obliquely, or metal hides it; turn the C-arm towards the hole"
            )
    _refuse_one_rim(points, everything)
    if pose is not None:
        return _anchored(
            np.concatenate([pose.nail_mm, pose.along, pose.hole_mm, pose.axis, np.zeros(2), nail.radii_mm])
        )
    focal = focal_mm[[np.flatnonzero(points.view == v)[0] for v in (i, j)]]
    middles = [unit(rays[rims & (points.view == v)].mean(axis=0)) for v in (i, j)]
    middle = nearest_approach(focal[0], middles[0], focal[1], middles[1]).middle_mm
    outlines = [[rays[(points.view == v) & (points.kind == kind)] for kind in (0, 1)] for v in (i, j)]
    on_nail, along = nail_line(focal, outlines, middle)
    first = unit(across(beams[0], along))
    angle = np.deg2rad(np.arange(-90.0, 90.0, 5.0))[:, None]  # the entry is towards the first view's source
    axes = np.cos(angle) * first + np.sin(angle) * np.cross(along, first)
    states = np.zeros((len(axes), 17))
    states[:, _NAIL] = states[:, _HOLE] = on_nail
    states[:, _ALONG], states[:, _AXIS], states[:, _SIZES] = along, axes, nail.radii_mm
    return states[
        int(np.median(np.abs(_residuals(states, focal_mm, on_plane_mm, points.kind)[:, rims]), axis=1).argmin())
    ]


def farthest_apart(beams: np.ndarray) -> tuple[int, int]:
    """Return the places of the two beams, of unit vectors (V, 3), that are farthest apart.

    Raises ReconstructionRefusedError for less than 20°.
    """
    apart = np.arccos(np.clip(np.abs(beams @ beams.T), 0.0, 1.0))
    i, j = np.unravel_index(int(apart.argmax()), apart.shape)
    if apart[i, j] < MIN_ANGLE_RAD:
        raise ReconstructionRefusedError(
            f"the views are {np.rad2deg(apart[i, j]):.0f}° apart (at least {np.rad2deg(MIN_ANGLE_RAD):.0f}° is needed "
            "for the direction of a hole); turn the C-arm further for one of them"
        )
    return int(i), int(j)


def nail_line(
    focal_mm: np.ndarray, outlines: Sequence[Sequence[np.ndarray]], near_mm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the point (3,) of a nail's axis level with `near_mm` (3,), and the unit vector (3,) along it.

    From the unit rays (M, 3) of both outlines in two views, with focal points (2, 3): the plane halfway between two
    outlines contains the axis. Raises ReconstructionRefusedError where the planes do not determine it.
    """
    planes = []
    for both in outlines:
        first, second = (np.linalg.svd(rays)[2][2] for rays in both)
        planes.append(unit(first + np.sign(first @ second) * second))
    along = np.cross(*planes)
    if np.linalg.norm(along) < np.sin(MIN_ANGLE_RAD) / 2:
        raise ReconstructionRefusedError(
            "the nail lies in the plane of both beams, where two images do not determine its axis; turn the C-arm "
            "around the nail, not along it"
        )
    along = unit(along)
    offsets = [*(np.array(planes) * focal_mm).sum(axis=1), float(along @ near_mm)]
    return np.linalg.solve(np.vstack([*planes, along]), offsets), along


def turned_to_rims(cameras: Sequence[LocalCamera], seen: Sequence[HoleSeen], nail: Nail, start: HolePose) -> HolePose:
    """Return a pose near the start whose rims pass through those seen: rotated about the nail's axis, moved along it.

    Without errors of the views: for a first look at where the rims are. Up to half of the points may be wrong.
    """
    focal, points, kind = [], [], []
    for camera, rims in zip(cameras, seen, strict=True):
        for which, edge in ((_ENTRY, rims.entry), (_EXIT, rims.exit)):
            focal.append(np.broadcast_to(camera.focal_mm, (len(edge.uv_px), 3)))
            points.append(camera.focal_mm + camera.rays(edge.uv_px))
            kind.append(np.full(len(edge.uv_px), which))
    focal_mm, points_mm, kinds = (np.concatenate(parts) for parts in (focal, points, kind))
    aside = np.cross(start.along, start.axis)

    def states(moves: np.ndarray) -> np.ndarray:
        at, roll = moves[:, :1], moves[:, 1:]
        holes, axes = start.nail_mm + at * start.along, np.cos(roll) * start.axis + np.sin(roll) * aside
        rest = np.concatenate([np.zeros(2), nail.radii_mm])
        fixed = [np.broadcast_to(part, (len(moves), len(part))) for part in (start.nail_mm, start.along, rest)]
        return np.hstack([fixed[0], fixed[1], holes, axes, fixed[2]])

    move = np.zeros(2)
    for _ in range(_TURNS):
        tried = move + np.vstack([np.zeros(2), *np.diag(_TURN_STEPS), *-np.diag(_TURN_STEPS)])
        values = _residuals(states(tried), focal_mm, points_mm, kinds)
        design = (values[1:3] - values[3:]) / (2 * _TURN_STEPS[:, None])
        weight = 1 / (1 + (values[0] / max(MAD_TO_SD * float(np.median(np.abs(values[0]))), 1e-3)) ** 2)
        move = move - np.linalg.solve((design * weight) @ design.T + 1e-9 * np.eye(2), (design * weight) @ values[0])
    state = states(move[None])[0]
    return HolePose(start.nail_mm, start.along, state[_HOLE], state[_AXIS])


def _crossings(states: np.ndarray) -> np.ndarray:
    """Return entry and exit (K, 6), where the hole's axis crosses the nail's surface."""
    hole, axis, line = states[:, _HOLE], unit(states[:, _AXIS]), (states[:, _NAIL], unit(states[:, _ALONG]))
    near, far = through_surface(hole, axis, line, states[:, _WALL])[..., None]
    return np.hstack([hole + near * axis, hole + far * axis])


def _budget(
    points: _Points, solved: _Solved, kept: np.ndarray, by_parameters: np.ndarray, whole: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the covariance (6, 6) of entry and exit from each source of the lines' errors; "picks": all others of the
    whole one."""
    by, columns = points.by_numbers(solved.state, solved.numbers)[kept], points.columns[kept]
    to_ends = by_parameters @ solved.gain
    response = np.zeros((6, len(points.measured)))
    np.add.at(response.T, columns.ravel(), (to_ends.T[:, None, :] * by[:, :, None]).reshape(-1, 6))
    lines, budget = points.sights.lines, {}
    for source in SOURCES:
        known = joint_covariance(lines, ((source,),))
        assert known is not None  # noqa: S101 - `_Points.of` refuses views of unknown error
        budget[source] = response @ known[0] @ response.T
    budget["picks"] = whole - np.sum(list(budget.values()), axis=0)
    return budget


def _undetermined() -> ReconstructionRefusedError:
    return ReconstructionRefusedError(
        "the edges do not determine the hole's axis: too few of them belong to one hole, or the views do not belong "
        "together; click the hole again, on images that show more of its rims"
    )


def _refuse_one_rim(points: _Points, kept: np.ndarray) -> None:
    counts = points.counts(kept).sum(axis=0)
    for kind, name in ((_ENTRY, "entry"), (_EXIT, "exit")):
        if counts[kind] < MIN_RIM_POINTS:
            raise ReconstructionRefusedError(
                f"the images show {counts[kind]} points of the {name} rim (at least {MIN_RIM_POINTS} are needed): one "
                "rim alone gives no axis; turn the C-arm until both rims show, or take metal out of the beam"
            )


def _refuse_another(solved: _Solved, nail: Nail) -> None:
    """Raise ReconstructionRefusedError where the edges contradict the stated sizes or the nail is bent too much."""
    what = "the hole's diameter", "the nail's diameter", "the distance between the rims"
    stated = nail.hole_mm, nail.diameter_mm, nail.diameter_mm
    off, sd = solved.freely
    worst = int(np.argmax(np.abs(off) / sd))
    if abs(off[worst]) > max(_MAX_SIZE_MM, TWO_SIDED_999 * sd[worst]):
        raise ReconstructionRefusedError(
            f"{what[worst]} is {stated[worst] + 2 * off[worst]:.1f} mm in the images and {stated[worst]:.1f} mm as "
            "stated: it is another nail or another hole; give the sizes of this nail, or click its hole again"
        )
    bend = float(np.linalg.norm(solved.state[_BEND]))
    if bend > _MAX_BEND * BEND_PER_MM:
        raise ReconstructionRefusedError(
            f"the nail is bent by {np.rad2deg(bend) * 100:.1f}° over 100 mm (at most "
            f"{np.rad2deg(_MAX_BEND * BEND_PER_MM) * 100:.0f}° fit the model), or the strokes follow something else; "
            "draw the strokes along the nail beside the hole"
        )


def _rims_used(points: _Points, kept: np.ndarray) -> Check:
    """Return the check that most points of the rims in every view fit: a movement makes the fit drop a whole view."""
    rims = points.kind >= _ENTRY
    used = points.counts(kept & rims).sum(axis=1) / points.counts(rims).sum(axis=1)
    worst = int(used.argmin())
    share, passed = float(used[worst]), bool(used[worst] >= _MIN_USED)
    sentence = (
        "Most points of the rims fit the hole in every view."
        if passed
        else f"Only {share:.0%} of the rims' points in the view {points.names[worst]!r} fit the hole that the other "
        "edges show: the patient moved, other metal covers the rims, or a click is on another hole. Click again, or "
        "take both images again."
    )
    return Check("hole rims used", passed, share, _MIN_USED, "", sentence)


def _checks(solved: _Solved) -> tuple[Check, ...]:
    limit = ellipsoid_factor(CONFIDENCE, solved.freedom) ** 2
    agrees = solved.chi_square <= limit
    sentence = (
        "The edges in all images fit one hole of this nail."
        if agrees
        else "The edges do not fit one hole: the patient moved between the images, or edges of other objects were "
        "taken for the hole's. Take both images again."
    )
    state = solved.state
    along, axis = unit(state[_ALONG]), unit(state[_AXIS])
    tilt = float(np.arcsin(abs(along @ axis)))
    off = float(np.linalg.norm(np.subtract(*(state[at] for at in (_HOLE, _NAIL)))))
    across_nail = tilt <= _MAX_TILT_RAD and off <= _MAX_OFF_MM
    beside = (
        "The hole runs across the nail and through its axis."
        if across_nail
        else f"The hole found passes the nail's axis at {off:.1f} mm and its normal at {np.rad2deg(tilt):.1f}°: it is "
        "not a transverse hole, or the rims were confused. Click the hole again in both images."
    )
    return (
        Check("hole agreement", agrees, solved.chi_square, limit, "χ²", sentence),
        Check(
            "hole across the nail", across_nail, float(np.rad2deg(tilt)), float(np.rad2deg(_MAX_TILT_RAD)), "°", beside
        ),
    )


def rims_disagree(  # noqa: PLR0917
    ends_mm: np.ndarray,
    covariance_mm2: np.ndarray,
    gain: np.ndarray,
    left: np.ndarray,
    redundant: np.ndarray,
    rims: Sequence[np.ndarray],
) -> float:
    """Return how much the axis changes when half a rim is left out, over what its errors explain: 1 is expected.

    A jackknife of blocks: an edge that is taken for a rim, such as that of other metal, moves a whole piece of it.
    Neighbouring points are then wrong together, which no point's own variance holds.

    Squared changes across the axis, in units of its covariance, are added for both halves of each rim of each view.
    `ends_mm` (6,), `covariance_mm2` (6, 6): both ends of the axis; `gain` (6, K): their response to the K residuals of
    the adjustment; `left` (K,), `redundant` (K, K): its weighted residuals and their covariance; `rims`: the places of
    each rim's points, in their order along it.
    """
    across = np.kron(np.eye(2), np.linalg.svd((ends_mm[3:] - ends_mm[:3])[None])[2][1:])
    precision, gain = np.linalg.inv(across @ covariance_mm2 @ across.T), across @ gain
    seen = expected = 0.0
    for half in (half for rim in rims for half in np.array_split(rim, 2) if len(half)):
        # Without these points the axis moves by the gain times what the other points predict for them.
        response = np.linalg.solve(redundant[np.ix_(half, half)], gain[:, half].T).T
        change = response @ left[half]
        seen += float(change @ precision @ change)
        expected += float(np.trace(precision @ response @ gain[:, half].T))
    return seen / expected if expected > 0 else 1.0
