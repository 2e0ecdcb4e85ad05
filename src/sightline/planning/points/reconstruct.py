"""Points from picks in two or more views: closest approach (the paper) or covariance-weighted; lengths, angles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sightline.calibration.solids.calibrate_together import adjusted_together
from sightline.calibration.view import CalibratedView, LinesOfSight
from sightline.common.geometry.covariance import TWO_SIDED_95, block_diagonal, response
from sightline.common.threads import one_blas_thread
from sightline.errors import OutsideRegionError, ReconstructionRefusedError, UnusableInputError
from sightline.planning.points.gaps import Gaps, gap_mm
from sightline.planning.points.lines_of_sight import refuse_repeated
from sightline.planning.points.picks import DEFAULT_PICK_SD_PX, PickArrays
from sightline.planning.points.results import MAX_GAP_SIGMA, SpacePoints
from sightline.planning.points.solution import Method, Solution, solve


@one_blas_thread
def reconstruct(
    views: Sequence[CalibratedView],
    uv_px: np.ndarray | Mapping[str, np.ndarray],
    uv_covariance_px2: np.ndarray | Mapping[str, np.ndarray] | None = None,
    method: Method = "weighted",
    across_px: np.ndarray | None = None,
) -> SpacePoints:
    """Return the points seen at pixels `uv_px` (V, N, 2) of two or more views, with their joint covariance, CFCS.

    The views of a solid are adjusted together first (`adjusted_together`).
    The axes of `uv_px` are view, point and (u, v); NaN where a view does not show a point: two others must show it. For
    two points in two views, (point, view, (u, v)) has the same shape: to rule out confusion pass the pixels by the
    views' names, `{"pa": (N, 2), "lateral": (N, 2)}`. `uv_covariance_px2` (V, N, 2, 2), or by the views' names: of the
    picks; by default 0.5 px per axis, a careful click. `across_px` (V, N, 2): for a pick snapped to an image-matching
    curve the direction across the curve, in which it measures nothing; zero for a free pick (see `Pick`).

    `method`: "nearest", the point with the smallest summed squared distance from its lines of sight, with two views the
    middle of their closest approach (the paper, eqs 1 and 2), or "weighted", the maximum-likelihood point given the
    covariance of the lines of sight and the picks. Where a view's error is unknown there are no weights: "nearest" is
    used, and the result's `method` says so. Each point is computed from its own picks only, so a bad pick moves no
    other point; the points' errors are still correlated. Look at the result's `checks`.
    Raises UnusableInputError, ReconstructionRefusedError, OutsideRegionError.

    >>> pa, lateral = sl.load("out/demo/views.json")
    >>> points = sl.reconstruct([pa, lateral], {"pa": [[704, 425]], "lateral": [[439, 358]]})
    >>> points.xyz_mm.round()
    array([[-22., -26.,   4.]])
    """
    refuse_repeated(views)
    views = adjusted_together(views)
    uv_covariance_px2 = None if uv_covariance_px2 is None else _by_view(views, uv_covariance_px2, "covariances")
    picks = checked_picks(len(views), _by_view(views, uv_px, "picks"), uv_covariance_px2, across_px)
    lines = [view.lines_of_sight(uv[shown]) for view, uv, shown in zip(views, picks.uv_px, picks.seen, strict=True)]
    return points_of(solve(lines, picks, method))


# Where both images show the beams' common normal alike, exchanged picks have nearly the same gaps: here they have not
# [ours].
_FAR_SIGMA = 3 * MAX_GAP_SIGMA


def refuse_exchanged(views: Sequence[CalibratedView], uv_px: np.ndarray, sd_px: np.ndarray) -> None:
    """Raise UnusableInputError where picks `uv_px` (V, N, 2) of two points or more fit only with two views exchanged.

    `sd_px` (N,): standard deviation of the picks of a point. Picks that contradict their views by little are not
    refused.
    """
    uv = np.asarray(uv_px, dtype=np.float64)
    if uv.shape[1] < 2 or not _worst_gap_sigma(views, uv, sd_px) > _FAR_SIGMA:
        return
    for a, b in combinations(range(len(views)), 2):
        order = np.arange(len(views))
        order[[a, b]] = b, a
        if _worst_gap_sigma(views, uv[order], sd_px) <= MAX_GAP_SIGMA:
            one, other = views[a].name, views[b].name
            raise UnusableInputError(
                f"the images of {one} and {other} are exchanged, or the picks in them: the lines of sight of the "
                f"{uv.shape[1]} points meet only if they are exchanged back; give the files in the other order, and "
                "write each pick beside its own image"
            )


def _worst_gap_sigma(views: Sequence[CalibratedView], uv_px: np.ndarray, sd_px: np.ndarray) -> float:
    """Return the largest gap of the points in standard deviations; NaN where it is not known."""
    covariance = np.broadcast_to((sd_px**2)[:, None, None] * np.eye(2), (*uv_px.shape, 2))
    try:
        sigma = reconstruct(views, uv_px, covariance).gap_sigma
    except (ReconstructionRefusedError, OutsideRegionError, UnusableInputError):
        return np.nan
    return np.nan if sigma is None else float(np.max(np.ma.getdata(sigma)))


def points_of(solution: Solution) -> SpacePoints:
    """Return the points of a solution with their joint covariance, gaps, and what these show of a movement."""
    lines, picks = solution.lines, solution.picks
    seen, two = picks.seen, len(lines) == 2
    budget, gap, gaps = solution.budget_mm2(), gap_mm(solution), Gaps.of(solution)
    tested = 2 * seen.sum(axis=0) - picks.snapped.sum(axis=0) > 3
    shift, shift_sd, chi2 = (None, None, None) if gaps is None or not tested.any() else gaps.mean()
    upright = [sight.upright for sight in lines if sight.upright is not None]
    inside = np.ones_like(seen)
    inside[seen] = np.concatenate([sight.inside_hull for sight in lines])
    return SpacePoints(
        xyz_mm=solution.xyz_mm,
        gap_mm=gap,
        gap_tested=tested,
        gap_sigma=None if gaps is None else np.ma.masked_array(gaps.sigma(gap), mask=~tested),
        joint_covariance_mm2=None if budget is None else np.sum(list(budget.values()), axis=0),
        budget_mm2=budget,
        inside_hull=np.logical_and.reduce(inside),
        method=solution.method,
        shift_mm=shift if two else None,
        shift_sd_mm=shift_sd if two else None,
        gap_chi2=chi2,
        upright=any(upright) if upright else None,
        beads_near=_beads_near(lines, seen),
        movement=None if chi2 is None or gaps is None or two else gaps.movement(solution),
    )


def _beads_near(lines: Sequence[LinesOfSight], seen: np.ndarray) -> dict[str, np.ndarray] | None:
    """Return for each view of the frame the beads near its points, (N, 3); -1 where it does not show a point."""
    by_view = {}
    for sight, shown in zip(lines, seen, strict=True):
        if sight.beads_near is not None:
            by_view[sight.view] = np.full((len(shown), 3), -1)
            by_view[sight.view][shown] = sight.beads_near
    return by_view or None


def _by_view(views: Sequence[CalibratedView], given: np.ndarray | Mapping[str, np.ndarray], what: str) -> np.ndarray:
    """Return values given by the views' names as an array in the views' order; arrays unchanged.

    Raises UnusableInputError.
    """
    if not isinstance(given, Mapping):
        return given
    names = [view.name for view in views]
    if len(set(names)) < len(names) or set(given) != set(names):
        raise UnusableInputError(
            f"the {what} are given for {', '.join(map(repr, given))}, the views are {', '.join(map(repr, names))}; "
            "give an entry for each view, and views of different names"
        )
    shapes = {np.shape(given[name]) for name in names}
    if len(shapes) > 1:
        raise UnusableInputError(
            f"the {what} have different shapes in the views; give the same points in each, NaN where one is not seen"
        )
    return np.array([given[name] for name in names], dtype=np.float64)


def checked_picks(
    views: int, uv_px: np.ndarray, covariance_px2: np.ndarray | None, across_px: np.ndarray | None
) -> PickArrays:
    """Return the picks of N points in V views, (V, N, 2), made regular. Raises UnusableInputError."""
    uv = np.asarray(uv_px, dtype=np.float64)
    if uv.ndim != 3 or uv.shape[0] != views or uv.shape[2] != 2 or uv.shape[1] == 0:
        raise UnusableInputError(f"picks have the shape {uv.shape}; give ({views}, N, 2): view, point, (u, v)")
    n = uv.shape[1]
    if covariance_px2 is None:
        covariance_px2 = np.broadcast_to(DEFAULT_PICK_SD_PX**2 * np.eye(2), (views, n, 2, 2))
    covariance = np.asarray(covariance_px2, dtype=np.float64)
    across = np.zeros((views, n, 2)) if across_px is None else np.asarray(across_px, dtype=np.float64)
    for name, array, shape in (("covariances", covariance, (views, n, 2, 2)), ("free directions", across, uv.shape)):
        if array.shape != shape:
            raise UnusableInputError(f"the picks' {name} have the shape {array.shape}; give {shape}")
    picks = PickArrays(uv, covariance, across)
    seen = picks.seen
    either = np.isfinite(uv).all(axis=-1) | np.isnan(uv).all(axis=-1)
    if not (either.all() and np.isfinite(covariance).all() and np.isfinite(across).all()):
        raise UnusableInputError("picks or their covariances are not finite; give each pick a pixel in its image")
    if (few := seen.sum(axis=0) < 2).any():
        raise UnusableInputError(
            f"point {few.argmax() + 1} has finite picks in {seen.sum(axis=0)[few][0]} views; pick each point in two or "
            "more images"
        )
    if not np.allclose(covariance, np.swapaxes(covariance, -1, -2)) or not _positive(covariance):
        raise UnusableInputError(
            "a pick's covariance is not symmetric and positive semi-definite; give a 2x2 covariance in px²"
        )
    if (picks.snapped.sum(axis=0) > 1).any():
        raise UnusableInputError(
            "a point is snapped in two views; snap it in one, to the curve of a free pick in another"
        )
    return picks.regular()


def _positive(covariance: np.ndarray) -> bool:
    """Whether no variance is below zero, up to rounding (a snapped pick's covariance is singular)."""
    values = np.linalg.eigvalsh(covariance)
    return bool((values[..., 0] >= -1e-9 * np.abs(values[..., 1])).all())


@dataclass(frozen=True)
class Measured:
    """A length, mm, between two clicks, or an angle, rad, at the second of three; in one image only of what lies in the
    plane.

    `error_95`: its 95 % error from picks and calibration, None where that is unknown. `per_mm`: share by which a length
    changes for each mm that what was clicked lies before or behind the plane; an angle between lines parallel to the
    plane does not.
    """

    value: float
    error_95: float | None
    per_mm: float


def measured_in_plane(
    view: CalibratedView, uv_px: np.ndarray, at_mm: np.ndarray, pick_sd_px: float = DEFAULT_PICK_SD_PX
) -> Measured:
    """Return the length between two pixels (2, 2), or the angle at the second of three (3, 2), in the plane through
    `at_mm` (3,). Raises OutsideRegionError, and UnusableInputError for pixels in one place."""
    uv = np.asarray(uv_px, dtype=np.float64)
    _refuse_one_place(uv)
    lines = view.lines_of_sight(uv)
    plane = lines.plane
    normal = np.cross(*plane.axes)

    def value(of: np.ndarray) -> np.ndarray:
        focal = of[:, None, :3]
        ray = plane.origin_mm + of[:, 3:].reshape(len(of), -1, 2) @ plane.axes - focal
        points = focal + ray * (((at_mm - focal) @ normal) / (ray @ normal))[..., None]
        return _size(points)

    (size,), by = response(value, np.concatenate([lines.focal_point_mm, lines.xy_mm.ravel()]))
    per_mm = float(1.0 / abs((lines.focal_point_mm - at_mm) @ normal)) if len(uv) == 2 else 0.0
    if lines.covariance is None:
        return Measured(float(size), None, per_mm)
    covariance = np.array(sum(lines.covariance.values()))
    covariance[3:, 3:] += block_diagonal(pick_sd_px**2 * lines.jacobian @ lines.jacobian.transpose(0, 2, 1))
    sd = float(np.sqrt((by @ covariance @ by.T)[0, 0]))
    return Measured(float(size), TWO_SIDED_95 * sd, per_mm)


def measured_in_space(
    views: Sequence[CalibratedView], uv_px: np.ndarray, pick_sd_px: float = DEFAULT_PICK_SD_PX
) -> Measured:
    """Return the length between two points that two views show at pixels (2, 2, 2), or the angle at the second of three
    (2, 3, 2): axes view, point, (u, v).

    Raises OutsideRegionError, ReconstructionRefusedError, and UnusableInputError for pixels in one place and where the
    lines of sight contradict each other: the clicks are not on the same points.
    """
    uv = np.asarray(uv_px, dtype=np.float64)
    for pixels in uv:
        _refuse_one_place(pixels)
    points = reconstruct(views, uv, np.broadcast_to(pick_sd_px**2 * np.eye(2), (*uv.shape, 2)))
    if points.gap_failed.any():
        raise UnusableInputError(
            f"lines of sight of the clicks pass each other at {np.max(points.gap_mm):.1f} mm; click the same places in "
            "both images, in the same order"
        )
    (size,), by = response(lambda of: _size(of.reshape(len(of), -1, 3)), points.xyz_mm.ravel())
    joint = points.joint_covariance_mm2
    error = None if joint is None else TWO_SIDED_95 * float(np.sqrt((by @ joint @ by.T)[0, 0]))
    return Measured(float(size), error, 0.0)


def _size(points: np.ndarray) -> np.ndarray:
    """Return the lengths between two points (K, 2, 3), or the angles at the second of three (K, 3, 3), as (K, 1)."""
    if points.shape[1] == 2:
        return np.linalg.norm(points[:, 1] - points[:, 0], axis=1, keepdims=True)
    first, other = points[:, 0] - points[:, 1], points[:, 2] - points[:, 1]
    across = np.linalg.norm(np.cross(first, other), axis=1, keepdims=True)
    return np.arctan2(across, (first * other).sum(axis=1, keepdims=True))


def _refuse_one_place(uv_px: np.ndarray) -> None:
    if (np.linalg.norm(np.diff(uv_px, axis=0), axis=1) < 1.0).any():
        raise UnusableInputError("click two places that are at least one pixel apart")
